"""What a fit says of a system and of its data: plain numbers, for a console, JSON and pictures."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification.parts import (
    IDENTIFIED,
    ActuatorEstimate,
    Estimate,
    Finding,
    HorizonError,
    Region,
    Residuals,
    Rollout,
    inside,
)
from phihp_torchrl.identification.table import lay_out
from phihp_torchrl.tasks import Actuator, Task

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Identification:
    """What recordings say of a system: constants, path of the command, errors, noise, warnings.

    Args:
        constants: by name, in the order of the system.
        combinations: combinations of constants that the data determine: those that the system
            declares, and those found where constants are not identified one by one.
        actuator: the path of the command.
        errors: by number of steps ahead, as text: ``errors["20"].states["angle"].rmse``.
        regions: errors at the longest horizon by parts of the state space.
        noise: standard deviation of each measured state, in its unit.
        warnings: what must be known; ``str`` of each has the advice with it.
        stops: stops that the task, the settings or the data gave, by the name of the position.
        restitution: how much of its speed a position keeps at its stops, by name.
        data: counts of samples, stretches and windows, and what was left out, by name.
        rollouts: some held-out predictions.
        residuals: what the fit leaves over.
        settings: how the model is integrated (``integrator``, ``substeps``) and other choices.
        units: of states, actions and constants by name, where the caller knows them.
        seconds: how long the identification took.

    Examples:
        >>> from phihp_torchrl.identification import StateError
        >>> found = Identification(
        ...     constants={"mass": Estimate(1.0, 1.2, 1.19, 1.21)},
        ...     combinations={},
        ...     actuator=ActuatorEstimate(delay_steps=2.0),
        ...     errors={"20": HorizonError({"angle": StateError(0.01, 0.02, 1.1, 50)}, 0.02, 1.1)},
        ...     regions=(),
        ...     noise={"angle": 0.009},
        ...     warnings=(Finding("clock", "The clock jitters.", "Use its stamps."),),
        ...     data={"samples": 3000},
        ... )
        >>> found.to_json()["errors"]["20"]["angle"]["rmse"], found.to_json()["warnings"]
        (0.01, ['The clock jitters. Use its stamps.'])
    """

    constants: Mapping[str, Estimate]
    combinations: Mapping[str, Estimate]
    actuator: ActuatorEstimate
    errors: Mapping[str, HorizonError]
    regions: tuple[Region, ...]
    noise: Mapping[str, float]
    warnings: tuple[Finding, ...]
    data: Mapping[str, Any]
    stops: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    restitution: Mapping[str, Estimate] = field(default_factory=dict)
    rollouts: tuple[Rollout, ...] = ()
    residuals: Residuals | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Plain values, ready for ``json.dump``; numbers that are not finite become ``None``."""
        plain = {f.name: _plain(getattr(self, f.name)) for f in fields(self)}
        plain["warnings"] = [str(warning) for warning in self.warnings]
        plain["findings"] = _plain(self.warnings)
        plain["errors"] = {
            steps: {
                **_plain(error.states),
                "share": _plain(error.share),
                "floor_ratio": _plain(error.floor_ratio),
            }
            for steps, error in self.errors.items()
        }
        return plain

    def save(self, path: str | Path) -> Path:
        """Write :meth:`to_json` to a file, and return its path."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
        return path

    def task(self, task: Task, *, fixed: bool = False) -> Task:
        """The task with the fitted constants as first guesses, the fitted actuator, and stops.

        Fixed constants stay, and so do stops that the task has. A delay is counted in steps of the
        task, which may be others than those of the recordings.

        Args:
            task: the task that was identified.
            fixed: whether constants that are identified are fixed, so that training keeps them. A
                warning says so where there are none.

        Raises:
            ConfigError: if its system does not have the constants.
        """
        ranges = task.system.ranges
        if missing := sorted(set(self.constants) - set(ranges)):
            raise ConfigError("task", f"{task.name} has no constants {missing}.")
        free = {name: c for name, c in self.constants.items() if not ranges[name].fixed}
        values = {name: inside(ranges[name], c.estimate) for name, c in free.items()}
        system = task.system.with_constants(values)
        if fixed:
            known = [name for name, c in free.items() if c.verdict == IDENTIFIED]
            if free and not known:
                _log.warning(
                    "fixed=True fixes no constant of %s, and training goes on to fit %s: none has "
                    "the verdict %r. Fix one that is known otherwise with "
                    "Constant(value, fixed=True), and identify again.",
                    task.name,
                    ", ".join(free),
                    IDENTIFIED,
                )
            system.ranges |= {n: replace(system.ranges[n], fixed=True) for n in known}
        return replace(
            task,
            system=system,
            actuator=self.actuator_for(task) or task.actuator,
            position_limits={**self.stops, **task.position_limits},
            restitution=self._bounces(task),
        )

    def _bounces(self, task: Task) -> float | Mapping[str, float]:
        """The restitution of the task, with what was identified of it."""
        told = {n: e.estimate for n, e in self.restitution.items() if e.verdict == IDENTIFIED}
        if not told:
            return task.restitution
        given = task.restitution
        if not isinstance(given, Mapping):
            given = {n: given for n in {**self.stops, **task.position_limits}}
        return {**given, **told}

    def actuator_for(self, task: Task) -> Actuator | None:
        """The fitted actuator with its delay in steps of ``task``; ``None`` for a perfect one."""
        actuator, step = self.actuator.actuator, self.data.get("step_s")
        if actuator is None or not step or abs(step / task.time_step - 1.0) < 0.02:
            return actuator
        delay, scale = actuator.delay_steps, step / task.time_step
        # A hair above a whole number of steps would be a register more.
        scaled = [round(scale * d, 6) for d in (delay if isinstance(delay, tuple) else (delay,))]
        return replace(
            actuator, delay_steps=tuple(scaled) if isinstance(delay, tuple) else scaled[0]
        )

    def table(self) -> str:
        """A page for a console."""
        return lay_out(self.to_json())

    def __str__(self) -> str:
        return self.table()


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
