"""The scale on which returns of different tasks are averaged."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import NamedTuple


class Bounds(NamedTuple):
    """The returns that count as 0 and as 1.

    Attributes:
        low: every step earns what the worst place earns, at rest.
        high: every step earns what the best place earns, at rest.
    """

    low: float
    high: float


BOUNDS = MappingProxyType(
    {
        "pendulum": Bounds(-200 * math.pi**2, 0.0),
        "pendulum-swingup": Bounds(-500 * math.pi**2, 0.0),
        "cartpole": Bounds(0.0, 500.0),
        "cartpole-swingup": Bounds(0.0, 500.0),
        "cartpole-swingup-published": Bounds(0.0, 500.0),
        "acrobot": Bounds(-500.0, 0.0),
        "acrobot-swingup": Bounds(-500.0, 500.0),
    }
)
"""By task; a pendulum's worst place is hanging down, an acrobot's too, a cart's far away."""


EQUIVALENT = 0.01
"""Two returns are equivalent whose difference is, by its whole interval, within this share of the
range between a task's bounds: stated before any run that is tested by it."""


def margin(task: str) -> float | None:
    """The margin of equivalence of a task's returns; ``None`` for a task that has no bounds.

    Examples:
        >>> margin("acrobot")
        5.0
    """
    if task not in BOUNDS:
        return None
    low, high = BOUNDS[task]
    return EQUIVALENT * (high - low)


def normalise(task: str, value: float) -> float:
    """A return on the scale from 0 to 1.

    Raises:
        ValueError: for a task that has no bounds.

    Examples:
        >>> normalise("acrobot", -100.0)
        0.8
    """
    if task not in BOUNDS:
        raise ValueError(f"task: expected one of {sorted(BOUNDS)}, got {task!r}.")
    low, high = BOUNDS[task]
    return (value - low) / (high - low)
