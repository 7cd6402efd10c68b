"""An identification as lines that are ready to be pasted into a task's Python and its settings."""

from __future__ import annotations

import math
from collections.abc import Iterator

from phihp_torchrl.identification.parts import FIXED, IDENTIFIED, inside
from phihp_torchrl.identification.result import Identification
from phihp_torchrl.systems import Constant
from phihp_torchrl.tasks import Task


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
    actuator = found.actuator_for(task)
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
    if told := {n: e.estimate for n, e in found.restitution.items() if e.verdict == IDENTIFIED}:
        given.append(f"restitution={{{', '.join(f'{n!r}: {v:.3g}' for n, v in told.items())}}},")
    if given:
        lines["Task(...), in Python"] = "\n".join(given)
    return lines


def _constants(task: Task, found: Identification) -> Iterator[str]:
    yield "default_constants = {"
    for name, c in found.constants.items():
        declared = task.system.ranges.get(name, Constant(c.guess))
        value = _rounded(c.estimate)
        if declared.fixed:
            value = f"Constant({value}, fixed=True)"
        elif declared.bounded:
            value = _rounded(inside(declared, c.estimate))
            value = f"Constant({value}, low={declared.low:g}, high={declared.high:g})"
        known = c.verdict in (IDENTIFIED, FIXED)
        yield f'    "{name}": {value},' + ("" if known else f"  # {c.verdict}")
    yield "}"


def _rounded(value: object) -> str:
    """Six digits, which is more than any log tells."""
    if isinstance(value, float) and not math.isfinite(value):
        return f'float("{value}")'
    return repr(float(f"{value:.6g}")) if isinstance(value, float) else repr(value)
