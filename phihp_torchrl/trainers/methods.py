"""The systems that the paper compares: the phases of each, and how each acts."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

ACTING = ("hybrid_planner", "plain_planner", "actor", "own_planner")
"""Planning with actor and Q, without them, the actor alone, or a planner that a phase brings."""


@dataclass(frozen=True)
class Method:
    """A method is its phases, how its agent acts, and settings (``recipes/config/method/``).

    A phase has a section of its own name in the run's configuration, and the planner has one. The
    sections that a method has no use for are ``None`` in its configuration.

    Args:
        label: the paper's name of it.
        phases: in their order; each is one of :data:`~phihp_torchrl.trainers.phases.PHASE_KINDS`.
        acting: one of :data:`ACTING`.
        model_kind: the ``model.kind`` without which it would be another method; ``None`` for any.

    Raises:
        ValueError: if there are no phases, or ``acting`` is unknown.
    """

    label: str
    phases: tuple[str, ...]
    acting: str = "hybrid_planner"
    model_kind: str | None = None

    def __post_init__(self) -> None:
        if not self.phases:
            raise ValueError("phases: expected at least one, got none.")
        if self.acting not in ACTING:
            raise ValueError(f"acting: expected one of {list(ACTING)}, got {self.acting!r}.")

    @property
    def plans(self) -> bool:
        """Whether its agent acts by the planner of section ``planner``."""
        return self.acting in ("hybrid_planner", "plain_planner")

    @property
    def sections(self) -> tuple[str, ...]:
        """The sections of the configuration that it reads."""
        return (*self.phases, "planner") if self.plans else self.phases


_IMAGINED = ("model", "policy", "evaluate")
_REAL = ("model", "td3", "evaluate")
_PLANNED = ("model", "evaluate")

METHODS = {
    "phihp": Method("PhIHP", _IMAGINED),
    "td3-im-ph": Method("TD3-im-ph", _IMAGINED, acting="actor", model_kind="hybrid"),
    "td3-im-dd": Method("TD3-im-dd", _IMAGINED, acting="actor", model_kind="data_driven"),
    "td3": Method("TD3", ("td3", "evaluate"), acting="actor"),
    "ph-td-mpc-star": Method("Ph-TD-MPC*", _REAL, model_kind="hybrid"),
    "td-mpc-star": Method("TD-MPC*", _REAL, model_kind="data_driven"),
    "ph-cem": Method("Ph-CEM", _PLANNED, acting="plain_planner", model_kind="hybrid"),
    "dd-cem": Method("dd-CEM", _PLANNED, acting="plain_planner", model_kind="data_driven"),
    "td-mpc": Method("TD-MPC", ("tdmpc", "evaluate"), acting="own_planner"),
    "cem-oracle": Method("CEM-oracle", _PLANNED, acting="plain_planner", model_kind="oracle"),
}
"""Methods by name; a plugin may add its own with :func:`register_method`."""


def register_method(name: str, method: Method) -> Method:
    """Make ``method`` known by ``name`` to configurations and recipes; returns it.

    Raises:
        ValueError: if the name is taken.
    """
    if name in METHODS:
        raise ValueError(f"method: {name!r} is registered already.")
    METHODS[name] = method
    return method


def get_method(name: str) -> Method:
    """Return the method of that name.

    Raises:
        ValueError: if there is none; the message lists those that are.

    Examples:
        >>> get_method("dd-cem").phases
        ('model', 'evaluate')
    """
    if name not in METHODS:
        close = get_close_matches(name, METHODS, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        raise ValueError(f"method: expected one of {sorted(METHODS)}, got {name!r}{hint}")
    return METHODS[name]
