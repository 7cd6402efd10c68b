"""Durations as people say them."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """A duration in words, as precise as it is of use.

    Args:
        seconds: the duration.

    Examples:
        >>> duration(4.2), duration(75), duration(600), duration(5400), duration(90000)
        ('4 s', '1 min 15 s', '10 min', '1 h 30 min', '25 h')
    """
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 10:
        rest = 5 * (rest // 5)
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    if minutes < 60:
        return f"{minutes} min"
    hours, rest = divmod(minutes, 60)
    return f"{hours} h {rest} min" if rest and hours < 10 else f"{hours} h"
