"""A task with what was identified, from the report on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification.parts import ActuatorEstimate, Estimate
from phihp_torchrl.identification.result import Identification
from phihp_torchrl.tasks import Task


def identified_task(task: Task, report: str | Path, *, fixed: bool = False) -> Task:
    """Return the task with the constants, the actuator and the stops of an identification.

    The constants become first guesses, which training goes on to fit. Fixed ones stay, and so do
    stops that the task has. A delay is counted in steps of the task.

    Args:
        task: the task that was identified.
        report: ``identification.json``, which ``phihp identify`` and
            :meth:`Identification.save` write, or the directory that it is in.
        fixed: whether training keeps the constants that are identified as they are. Training fits
            single steps from the measured states, and so noise, or a velocity that was estimated,
            biases its constants, while an identification is not biased by them.

    Raises:
        ConfigError: for a file that is absent or no such report, and for one of another system.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl.tasks import get_task
        >>> found = Identification(
        ...     constants={"length": Estimate(1.0, 1.2, 1.19, 1.21)}, combinations={},
        ...     actuator=ActuatorEstimate(delay_steps=2.0), errors={}, regions=(), noise={},
        ...     warnings=(), data={},
        ... )
        >>> with tempfile.TemporaryDirectory() as place:
        ...     _ = found.save(f"{place}/identification.json")
        ...     better = identified_task(get_task("pendulum"), place)
        >>> better.system.constants["length"], better.actuator
        (1.2, Actuator(delay_steps=2.0, lag=0.0, slew=None, dead_zone=0.0, gain_low=1.0))
    """
    found = _read(Path(report))
    if unknown := sorted(set(found.constants) - set(task.system.ranges)):
        known = list(task.system.constants)
        raise ConfigError("report", f"{report} has the constant {unknown[0]!r}, expected {known}.")
    return found.task(task, fixed=fixed)


def _read(path: Path) -> Identification:
    """The parts of a report that a task needs."""
    path = path / "identification.json" if path.is_dir() else path
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
        constants = {name: Estimate(**each) for name, each in said["constants"].items()}
        actuator = ActuatorEstimate(**{**said["actuator"], "tried": ()})
        stops = {name: (low, high) for name, (low, high) in said["stops"].items()}
        bounces = {name: Estimate(**each) for name, each in said.get("restitution", {}).items()}
        data: dict[str, Any] = said["data"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            "report",
            f"expected an identification.json as `phihp identify` writes it, {path} is none: "
            f"{type(error).__name__}: {error}",
        ) from error
    return Identification(
        constants=constants,
        combinations={},
        actuator=actuator,
        errors={},
        regions=(),
        noise={},
        warnings=(),
        data=data,
        stops=stops,
        restitution=bounces,
    )
