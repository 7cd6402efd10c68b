"""The interface of phases, and the registered phases by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from phihp_torchrl.config import Registry, offer, to_mapping


class Phase(Protocol):
    """The interface of phases, which a run calls.

    A phase may also have an attribute ``real_steps``, the number of real steps that it has taken; a
    method ``parts``, which returns modules as keyword arguments of :class:`~phihp_torchrl.Agent`,
    or a whole agent as ``agent``; an attribute ``new_files``, a list of ``(label, path)`` of files
    for the logger; an attribute ``world``, the :class:`~phihp_torchrl.worlds.World` with which
    later phases go on, where the phase has found out more of its task; and an attribute ``keep``,
    which the run sets to a function that saves a checkpoint, for the phase to call within a unit of
    work when it has what must not be lost.
    An attribute ``planner_changes`` has settings of the planner that go with its parts and hold
    where the planner has the defaults, and ``summary`` plain values for the record of the run. A
    method ``trained`` returns the tensors that it trains, by name: a run stops when one of them
    leaves the finite numbers.

    Examples:
        >>> class Count:
        ...     def __init__(self):
        ...         self.count = 0
        ...
        ...     @property
        ...     def progress(self):
        ...         return self.count, 2
        ...
        ...     @property
        ...     def done(self):
        ...         return self.count == 2
        ...
        ...     def advance(self):
        ...         self.count += 1
        ...         return {"count/value": float(self.count)}
        ...
        ...     def state_dict(self):
        ...         return {"count": self.count}
        ...
        ...     def load_state_dict(self, state):
        ...         self.count = state["count"]
        >>> phase: Phase = Count()
        >>> while not phase.done:
        ...     metrics = phase.advance()
        >>> metrics, phase.progress
        ({'count/value': 2.0}, (2, 2))
    """

    @property
    def done(self) -> bool:
        """Whether all work of the phase is done."""

    @property
    def progress(self) -> tuple[int, int]:
        """Amount of work that is done, and of all work, in the unit of the phase."""

    def advance(self) -> dict[str, float]:
        """Do the next unit of work and return its metrics."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the phase, without global random states."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""


@dataclass(frozen=True)
class PhaseKind:
    """A registered kind of phase.

    Args:
        config: dataclass of its settings.
        build: a function that makes the phase from a :class:`~phihp_torchrl.trainers.Context`.
        unit: unit of its progress.
        needs_truth: whether it requires a simulated world.
        needs_env: whether it requires a world in which one can act.
    """

    config: type[Any]
    build: Callable[[Any], Phase]
    unit: str = "units"
    needs_truth: bool = False
    needs_env: bool = False


PHASES: Registry[PhaseKind] = Registry("phase")
"""Registered phases by name, of which methods are made."""

# Phases of the package that come with a folder of their own, and where that is.
_HOMES = {"tdmpc": "phihp_torchrl.tdmpc"}


def register_phase(
    name: str,
    config: type[Any],
    build: Callable[[Any], Phase],
    *,
    unit: str = "units",
    needs_truth: bool = False,
    needs_env: bool = False,
    replace: bool = False,
) -> PhaseKind:
    """Register a phase for methods, with its settings in the section of its name.

    Args:
        name: the name.
        config: dataclass of its settings.
        build: a function that makes the phase from a :class:`~phihp_torchrl.trainers.Context`.
        unit: unit of its progress.
        needs_truth: whether it requires a simulated world; runs in other worlds are then refused at
            the start.
        needs_env: whether it requires a world in which one can act; runs in a world of recordings
            are then refused at the start.
        replace: whether a phase of that name may be replaced.

    Returns:
        The registered kind of phase.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false.

    Examples:
        >>> @dataclass(frozen=True)
        ... class RestConfig:
        ...     days: int = 1
        >>> class Rest:
        ...     done, progress = True, (0, 0)
        >>> register_phase("rest", RestConfig, lambda context: Rest(), replace=True).unit
        'units'
    """
    kind = PHASES.register(
        name, PhaseKind(config, build, unit, needs_truth, needs_env), replace=replace
    )
    # Sections of the package's own phases are in defaults.yaml; train.yaml includes the others.
    sections = {
        each: to_mapping(of.config())
        for each, of in PHASES.items()
        if not of.config.__module__.startswith("phihp_torchrl.")
    }
    offer("phase", "registered", sections)
    return kind


def unknown_phases(names: Sequence[str]) -> list[str]:
    """The names of no registered phase; a phase of the package's own is imported by its name.

    Examples:
        >>> unknown_phases(("model", "tdmpc", "dream"))
        ['dream']
    """
    for name in names:
        if name not in PHASES and name in _HOMES:
            import_module(_HOMES[name])
    return [name for name in names if name not in PHASES]


def real_steps(phases: Mapping[str, Any]) -> int:
    """Return the number of real steps that these phases have taken."""
    return sum(getattr(phase, "real_steps", 0) for phase in phases.values())
