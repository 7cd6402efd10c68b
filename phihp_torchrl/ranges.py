"""Range checks of configurations: the first field out of range is refused by its name."""

from __future__ import annotations

from collections.abc import Callable


def check_positive(config: object, *names: str) -> None:
    """Refuse a field that is not above 0, NaN included.

    Raises:
        ValueError: for the first such field, beginning with its name.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_positive(SimpleNamespace(steps=3, rate=0.0), "steps", "rate")
        Traceback (most recent call last):
        ...
        ValueError: rate: expected a positive number, got 0.0.
    """
    _check(config, names, "a positive number", lambda value: value > 0)


def check_count(config: object, *names: str) -> None:
    """Refuse a field that is not 1 or above: a number of things, of which there must be one.

    Raises:
        ValueError: for the first such field, beginning with its name.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_count(SimpleNamespace(episodes=0.5), "episodes")
        Traceback (most recent call last):
        ...
        ValueError: episodes: expected a positive number, got 0.5.
    """
    _check(config, names, "a positive number", lambda value: value >= 1)


def check_not_negative(config: object, *names: str) -> None:
    """Refuse a field that is not 0 or above, NaN included.

    Raises:
        ValueError: for the first such field, beginning with its name.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_not_negative(SimpleNamespace(noise=0.0, start=-1), "noise", "start")
        Traceback (most recent call last):
        ...
        ValueError: start: expected a number >= 0, got -1.
    """
    _check(config, names, "a number >= 0", lambda value: value >= 0)


def check_share(config: object, *names: str) -> None:
    """Refuse a field that is not a share of something: 0 for none, 1 for all.

    Raises:
        ValueError: for the first such field, beginning with its name.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_share(SimpleNamespace(decay=1.5), "decay")
        Traceback (most recent call last):
        ...
        ValueError: decay: expected a number in [0, 1], got 1.5.
    """
    _check(config, names, "a number in [0, 1]", lambda value: 0 <= value <= 1)


def check_positive_share(config: object, *names: str) -> None:
    """Refuse a field that is not a share of something, or is none of it.

    Raises:
        ValueError: for the first such field, beginning with its name.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_positive_share(SimpleNamespace(gamma=0.0), "gamma")
        Traceback (most recent call last):
        ...
        ValueError: gamma: expected a number in (0, 1], got 0.0.
    """
    _check(config, names, "a number in (0, 1]", lambda value: 0 < value <= 1)


def _check(
    config: object, names: tuple[str, ...], expected: str, is_good: Callable[[float], bool]
) -> None:
    for name in names:
        value = getattr(config, name)
        if not is_good(value):
            raise ValueError(f"{name}: expected {expected}, got {value}.")
