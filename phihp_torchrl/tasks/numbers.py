"""Settings that are one number for every action, or one number for each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from phihp_torchrl.config import ConfigError, plain

Numbers = float | tuple[float, ...]
"""One number for every action, or one number each."""


def read_numbers(key: str, value: Any, *, positive: bool = False) -> Numbers:
    """Return ``value`` as a float or a tuple of floats.

    Args:
        key: name of the setting, for error messages.
        value: a number or a sequence of numbers.
        positive: whether zero is refused too.

    Raises:
        ConfigError: for anything but finite numbers of at least zero.

    Examples:
        >>> read_numbers("lag", [1, 2])
        (1.0, 2.0)
    """
    value = plain(value)
    listed = isinstance(value, (tuple, list))
    numbers = tuple(value) if listed else (value,)
    for number in numbers:
        known = isinstance(number, (int, float)) and not isinstance(number, bool)
        known = known and math.isfinite(number)
        if not known or number < 0 or (positive and number == 0):
            expected = "above 0" if positive else "of at least 0"
            raise ConfigError(key, f"expected numbers {expected}, got {value!r}.")
    kept = tuple(map(float, numbers))
    return kept if listed else kept[0]


def check_each(key: str, value: Numbers | None, actions: Sequence[str]) -> None:
    """Refuse numbers that are neither one for all actions nor one for each.

    Raises:
        ConfigError: naming the setting and the actions.
    """
    if isinstance(value, tuple) and len(value) != len(actions):
        raise ConfigError(
            key, f"expected one number, or one for each of {tuple(actions)}, got {value}."
        )


def one_each(value: Numbers, count: int) -> tuple[float, ...]:
    """The numbers of ``count`` actions."""
    return value if isinstance(value, tuple) else (value,) * count
