"""Numbers of which only the ends are known, as where one looks at a run now and then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Between:
    """A number that is more than ``low`` and at most ``high``; infinite where it was never met.

    Args:
        low: it is more than that.
        high: it is at most that.
    """

    low: float
    high: float

    def __str__(self) -> str:
        if self.high == float("inf"):
            return f"> {self.low:.0f}"
        return f"≤ {self.high:.0f}" if self.low <= 0 else f"{self.low:.0f}–{self.high:.0f}"


def mean_between(parts: Sequence[Between]) -> Between:
    """What the mean of such numbers lies between.

    Examples:
        >>> str(mean_between([Between(0, 250), Between(500, 1250)]))
        '250–750'
    """
    count = len(parts)
    return Between(sum(p.low for p in parts) / count, sum(p.high for p in parts) / count)


def ratio_between(above: Between, below: Between) -> Between:
    """What the ratio of two such numbers lies between.

    Examples:
        >>> str(ratio_between(Between(5000, 10000), Between(0, 250)))
        '> 20'
    """
    high = float("inf") if below.low <= 0 else above.high / below.low
    return Between(above.low / below.high, high)
