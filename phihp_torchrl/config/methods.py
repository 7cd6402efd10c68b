"""The methods that the paper compares: the phases, the acting and the settings of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from phihp_torchrl.config.checks import check_choice
from phihp_torchrl.config.choices import offer
from phihp_torchrl.config.errors import ConfigError
from phihp_torchrl.config.registry import Registry

ACTING = ("hybrid_planner", "plain_planner", "actor", "own_planner")
"""How an agent acts: by planning with actor and Q, by planning without them, by the actor alone, or
by a planner that a phase makes."""


@dataclass(frozen=True)
class Method:
    """A method to train an agent: its phases, how the agent acts, and its settings.

    Each phase reads the section of the settings that has its name, and the planner reads the
    section ``planner``. A run has only the sections that its method uses.

    Args:
        label: the method's name in the paper.
        about: description in one line.
        phases: names of registered phases, in order. One whose settings say ``enabled: false`` is
            not among those of a run.
        acting: how the agent acts, one of ``"hybrid_planner"`` (actor and Q help to plan),
            ``"plain_planner"``, ``"actor"`` and ``"own_planner"`` (a phase makes the planner).
        model_kind: the ``model.kind`` that the method requires; ``None`` if it works with any.
        changes: settings that the method changes in preset and task, as a nested mapping.
        group: the group in tables: ``"ours"``, ``"baseline"``, ``"ablation"`` or ``"imagined"``.
        samples_key: dotted key of the number of real samples, which a grid of runs varies;
            ``None`` if the method's number of samples is fixed.
        also_in: another method whose runs give results of this one as well, and how the agent acts
            for them: TD3-im-ph is the actor alone of a run of PhIHP.

    Raises:
        ConfigError: if there are no phases, or ``acting`` or ``group`` is unknown.

    Examples:
        >>> phases = ("model", "evaluate")
        >>> method = Method("Mine", "a hybrid model and plain CEM", phases, acting="plain_planner")
        >>> method.plans, method.sections
        (True, ('model', 'evaluate', 'planner'))
    """

    label: str
    about: str
    phases: tuple[str, ...]
    acting: str = "hybrid_planner"
    model_kind: str | None = None
    changes: Mapping[str, Any] = field(default_factory=dict, hash=False)
    group: str = "ablation"
    samples_key: str | None = None
    also_in: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        if not self.phases:
            raise ConfigError("phases", "expected at least one, got none.")
        check_choice(self, "acting", ACTING)
        check_choice(self, "group", ("ours", "baseline", "ablation", "imagined"))

    @property
    def plans(self) -> bool:
        """Whether the agent acts by the planner of the section ``planner``."""
        return self.acting in ("hybrid_planner", "plain_planner")

    @property
    def sections(self) -> tuple[str, ...]:
        """Names of the sections of the settings that the method reads."""
        return (*self.phases, "planner") if self.plans else self.phases

    @property
    def settings(self) -> dict[str, Any]:
        """The settings that the method changes, including the kind of its model."""
        changes = {key: value for key, value in self.changes.items()}
        if self.model_kind is not None:
            changes["model"] = {"kind": self.model_kind, **changes.get("model", {})}
        return changes


METHODS: Registry[Method] = Registry("method")
"""Registered methods by name."""


def register_method(name: str, method: Method, *, replace: bool = False) -> Method:
    """Register ``method`` under ``name``, so that settings can say ``method=name``; returns it.

    Args:
        name: the name.
        method: the method. Its phases need to be registered only when it is run.
        replace: whether a method of that name may be replaced.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false.

    Examples:
        >>> my_method = Method("Mine", "a hybrid model and plain planning", ("model", "evaluate"))
        >>> register_method("mine", my_method, replace=True).sections
        ('model', 'evaluate', 'planner')
    """
    METHODS.register(name, method, replace=replace)
    offer("method", name, {"method": name, "changes": method.settings})
    return method


def get_method(name: str) -> Method:
    """Return the registered method of that name.

    Raises:
        ConfigError: if there is none; the message lists the registered names.

    Examples:
        >>> get_method("dd-cem").phases
        ('model', 'evaluate')
    """
    return METHODS.find(name)


_IMAGINED = ("model", "policy", "evaluate")
_HYBRID = ("model", "policy", "calibrate", "evaluate")
_REAL = ("model", "td3", "calibrate", "evaluate")
_PLANNED = ("model", "evaluate")

# Plain CEM has no Q beyond its horizon, so it looks further ahead and discounts nothing. It is that
# of the paper: what a task changes in PhIHP's search is no part of it.
_PLAIN_CEM = MappingProxyType(
    {
        "planning_horizon": 30,
        "replan_every": 5,
        "num_candidates": 700,
        "num_policy_candidates": 0,
        "top_k": 20,
        "optim_steps": 3,
        "init_std": 1.0,
        "min_std": 0.0,
        "gamma": 1.0,
        "alpha": 1.0,
        "select": "mean",
        "num_kept_elites": 0,
        "warm_start": False,
        "keep_incumbent": False,
        "noise_beta": 0.0,
        "change_cost": 0.0,
    }
)

register_method(
    "phihp",
    Method(
        "PhIHP",
        "a hybrid model, actor and Q in imagination, planning with all three",
        _HYBRID,
        group="ours",
        samples_key="model.real_steps",
    ),
)
register_method(
    "dd-phihp",
    Method(
        "dd-PhIHP",
        "PhIHP with a model without prior",
        _HYBRID,
        model_kind="data_driven",
        samples_key="model.real_steps",
    ),
)
register_method(
    "td3-im-ph",
    Method(
        "TD3-im-ph",
        "the actor that PhIHP learns in imagination, acting alone",
        _IMAGINED,
        acting="actor",
        model_kind="hybrid",
        group="imagined",
        samples_key="model.real_steps",
        also_in=("phihp", "actor"),
    ),
)
register_method(
    "td3-im-dd",
    Method(
        "TD3-im-dd",
        "the same with a model without prior",
        _IMAGINED,
        acting="actor",
        model_kind="data_driven",
        group="imagined",
        samples_key="model.real_steps",
        also_in=("dd-phihp", "actor"),
    ),
)
register_method(
    "td3",
    Method(
        "TD3",
        "TD3 on real steps, without a model",
        ("td3", "evaluate"),
        acting="actor",
        group="baseline",
    ),
)
register_method(
    "td-mpc",
    Method(
        "TD-MPC",
        "latent model, policy and Q together from real steps, planning by MPPI",
        ("tdmpc", "evaluate"),
        acting="own_planner",
        group="baseline",
    ),
)
register_method(
    "cem-oracle",
    Method(
        "CEM-oracle",
        "plain CEM in the simulated world itself",
        _PLANNED,
        acting="plain_planner",
        model_kind="oracle",
        # The model is the simulated world itself, so no data are needed.
        changes={"model": {"real_steps": 0}, "planner": dict(_PLAIN_CEM)},
        group="baseline",
    ),
)
register_method(
    "ph-cem",
    Method(
        "Ph-CEM",
        "plain CEM in PhIHP's model, without a policy",
        _PLANNED,
        acting="plain_planner",
        model_kind="hybrid",
        changes={"planner": dict(_PLAIN_CEM)},
        samples_key="model.real_steps",
    ),
)
register_method(
    "dd-cem",
    Method(
        "dd-CEM",
        "plain CEM in a model without prior",
        _PLANNED,
        acting="plain_planner",
        model_kind="data_driven",
        changes={"planner": dict(_PLAIN_CEM)},
        samples_key="model.real_steps",
    ),
)
register_method(
    "ph-td-mpc-star",
    Method(
        "Ph-TD-MPC*",
        "PhIHP without imagination: actor and Q come from real steps",
        _REAL,
        model_kind="hybrid",
    ),
)
register_method(
    "td-mpc-star",
    Method(
        "TD-MPC*",
        "the same with a model without prior",
        _REAL,
        model_kind="data_driven",
    ),
)
