"""Checks of settings: the first field out of range is refused by its name.

Every dataclass of settings calls these in ``__post_init__``, so that a wrong number is refused when
the settings are read, before any work is done with them. NaN and infinities never pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from itertools import pairwise
from typing import Any

from phihp_torchrl.config.errors import ConfigError

LARGEST_FLOAT32 = 3.4028234663852886e38
"""The largest finite number in float32, in which everything is computed."""


def check_positive(config: object, *names: str) -> None:
    """Refuse a field that is not a finite number above 0.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_positive(SimpleNamespace(steps=3, rate=0.0), "steps", "rate")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: rate: expected a positive number, got 0.0.
    """
    _check(config, names, "a positive number", lambda value: _is_number(value) and value > 0)


def check_not_negative(config: object, *names: str) -> None:
    """Refuse a field that is not a finite number of 0 or above.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_not_negative(SimpleNamespace(noise=0.0, start=-1), "noise", "start")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: start: expected a number >= 0, got -1.
    """
    _check(config, names, "a number >= 0", lambda value: _is_number(value) and value >= 0)


def check_share(config: object, *names: str) -> None:
    """Refuse a field that is not a number from 0 to 1, both included.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_share(SimpleNamespace(decay=1.5), "decay")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: decay: expected a number in [0, 1], got 1.5.
    """
    _check(config, names, "a number in [0, 1]", lambda value: _is_number(value) and 0 <= value <= 1)


def check_positive_share(config: object, *names: str) -> None:
    """Refuse a field that is not a number above 0 and at most 1.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_positive_share(SimpleNamespace(gamma=0.0), "gamma")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: gamma: expected a number in (0, 1], got 0.0.
    """
    _check(config, names, "a number in (0, 1]", lambda value: _is_number(value) and 0 < value <= 1)


def check_count(config: object, *names: str, least: int = 1, most: str | None = None) -> None:
    """Refuse a field that is not a whole number from ``least`` to the value of the field ``most``.

    Args:
        config: the settings.
        names: names of the fields to check.
        least: the smallest allowed number.
        most: name of the field that holds the largest allowed number; ``None`` for no limit, and
            none either while one of both is a text of seconds.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_count(SimpleNamespace(top_k=9, num_candidates=8), "top_k", most="num_candidates")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: top_k: expected at most num_candidates = 8, got 9.
    """
    _check(config, names, f"a whole number >= {least}", lambda value: is_whole(value, least))
    for name in names if most is not None else ():
        value, limit = getattr(config, name), getattr(config, str(most))
        if not isinstance(limit, str) and value > limit:
            raise ConfigError(name, f"expected at most {most} = {limit}, got {value}.")


def check_choice(config: object, name: str, choices: Collection[Any]) -> None:
    """Refuse a field whose value is not among ``choices``.

    Raises:
        ConfigError: if the value is not among them.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_choice(SimpleNamespace(select="worst"), "select", ("mean", "best"))
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: select: expected one of ['mean', 'best'], got 'worst'.
    """
    value = getattr(config, name)
    if not any(value is choice or value == choice for choice in choices):
        raise ConfigError(name, f"expected one of {list(choices)}, got {value!r}.")


def check_widths(config: object, *names: str) -> None:
    """Refuse a field that is not a list of 1 to 32 layer widths, each of 1 to 65,536 units.

    The upper limits, and one of 2**28 weights between the layers, which are 1 GB, keep a wrong,
    damaged or hostile file from asking for all memory.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_widths(SimpleNamespace(sizes=(64, 0)), "sizes")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: sizes: expected 1 to 32 widths up to 65536, got (64, 0).
    """

    def good(value: Any) -> bool:
        return (
            isinstance(value, (list, tuple))
            and 1 <= len(value) <= 32
            and all(is_whole(width, 1) and width <= 65_536 for width in value)
            and sum(a * b for a, b in pairwise(value)) <= 2**28
        )

    _check(config, names, "1 to 32 widths up to 65536", good)


def is_whole(value: Any, least: int) -> bool:
    """Tell whether ``value`` is a whole number of at least ``least``; booleans are not numbers.

    Examples:
        >>> is_whole(3, 1), is_whole(True, 0), is_whole(2.5, 1)
        (True, False, False)
    """
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def check_memory(config: object, *names: str, each: int = 1) -> None:
    """Refuse whole numbers whose product is the size of one tensor of more than 8 GB.

    Args:
        config: the settings.
        names: names of the fields; one that is still a text of seconds counts as 1.
        each: numbers in an element of the tensor.

    Raises:
        ConfigError: for a product of more than 2**31; it names the largest of the fields.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_memory(SimpleNamespace(horizon=10**6, candidates=500), "horizon", "candidates")
        >>> check_memory(SimpleNamespace(horizon=10**6, candidates=5000), "horizon", "candidates")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: horizon: expected horizon * candidates of at most \
2147483648, else a tensor takes over 8 GB, got 5000000000.
    """
    sizes = {name: value for name in names if isinstance(value := getattr(config, name), int)}
    if (size := math.prod(sizes.values())) > (most := 2**31 // each):
        raise ConfigError(
            max(sizes, key=lambda name: sizes[name]),
            f"expected {' * '.join(sizes)} of at most {most}, else a tensor takes over 8 GB, "
            f"got {size}.",
        )


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number that float32 can hold; booleans are not numbers."""
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and abs(value) <= LARGEST_FLOAT32
    )


def _check(
    config: object, names: tuple[str, ...], expected: str, is_good: Callable[[Any], bool]
) -> None:
    for name in names:
        value = getattr(config, name)
        if not is_good(value):
            raise ConfigError(name, f"expected {expected}, got {value!r}.")
