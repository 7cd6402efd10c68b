"""An identification as lines that are ready to be pasted into a task's Python and its settings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from phihp_torchrl.identification.parts import FIXED, IDENTIFIED
from phihp_torchrl.identification.result import Identification
from phihp_torchrl.systems import Constant
from phihp_torchrl.tasks import Actuator, Task

_INSIDE = 1e-3
"""How far inside its range a first guess stays, as a share of it: its limits are not allowed."""


def ready_to_paste(task: Task, found: Identification) -> dict[str, str]:
    """Code with the fitted constants and the fitted actuator, by where it belongs.

    A delay is counted in the steps of the task, which may be others than those of the recordings.

    Args:
        task: the task that was identified.
        found: its identification.

    Examples:
        >>> from phihp_torchrl.identification.parts import ActuatorEstimate, Estimate
        >>> from phihp_torchrl.tasks import get_task
        >>> found = Identification(
        ...     constants={"length": Estimate(1.0, 1.2, 1.19, 1.21)}, combinations={},
        ...     actuator=ActuatorEstimate(delay_steps=2.0), errors={}, regions=(), noise={},
        ...     warnings=(), data={},
        ... )
        >>> for text in ready_to_paste(get_task("pendulum"), found).values():
        ...     print(text)
        default_constants = {
            "length": 1.2,
        }
        actuator: {delay_steps: 2.0}
        actuator=Actuator(delay_steps=2.0),
    """
    lines = {f"{type(task.system).__name__}, in Python": "\n".join(_constants(task, found))}
    given: list[str] = []
    actuator = actuator_of(task, found)
    if actuator is not None:
        numbers = {name: _rounded(value) for name, value in actuator.config.items()}
        python = ", ".join(f"{name}={value}" for name, value in numbers.items())
        yaml = ", ".join(f"{name}: {value}" for name, value in numbers.items())
        given.append(f"actuator=Actuator({python}),")
        lines[f"the actuator in the settings of {task.name}, in YAML"] = f"actuator: {{{yaml}}}"
    if new := {
        name: pair for name, pair in found.stops.items() if name not in task.position_limits
    }:
        pairs = (
            f'"{name}": ({_rounded(low)}, {_rounded(high)})' for name, (low, high) in new.items()
        )
        given.append(f"position_limits={{{', '.join(pairs)}}},")
    if given:
        lines["Task(...), in Python"] = "\n".join(given)
    return lines


def actuator_of(task: Task, found: Identification) -> Actuator | None:
    """The fitted actuator with its delay in steps of the task; ``None`` for a perfect one."""
    actuator, step = found.actuator.actuator, found.data.get("step_s")
    if actuator is None or not step or abs(step / task.time_step - 1.0) < 0.02:
        return actuator
    delay = found.actuator.delay_steps * step / task.time_step
    return replace(actuator, delay_steps=delay)


def _constants(task: Task, found: Identification) -> Iterator[str]:
    yield "default_constants = {"
    for name, c in found.constants.items():
        declared = task.system.ranges.get(name, Constant(c.guess))
        value = _rounded(c.estimate)
        if declared.fixed:
            value = f"Constant({value}, fixed=True)"
        elif declared.bounded:
            room = _INSIDE * (declared.high - declared.low)
            inside = min(max(c.estimate, declared.low + room), declared.high - room)
            value = _rounded(inside)
            value = f"Constant({value}, low={declared.low:g}, high={declared.high:g})"
        known = c.verdict in (IDENTIFIED, FIXED)
        yield f'    "{name}": {value},' + ("" if known else f"  # {c.verdict}")
    yield "}"


def _rounded(value: object) -> str:
    """Six digits, which is more than any log tells."""
    if isinstance(value, float) and not math.isfinite(value):
        return f'float("{value}")'
    return repr(float(f"{value:.6g}")) if isinstance(value, float) else repr(value)
