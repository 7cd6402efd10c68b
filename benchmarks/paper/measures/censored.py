"""Numbers of which only the ends are known, as where one looks at a run now and then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

RESAMPLES = 10_000
"""Resamples of a bootstrap over seeds."""


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


def ratio_interval(
    above: Sequence[Between], below: Sequence[Between], level: float = 0.95
) -> Between:
    """The interval of a ratio of means, by a percentile bootstrap over the seeds of either side.

    What the means lie between does not say how they vary from seed to seed. The lower limit is that
    of the least that the ratio may be, the upper limit that of the most. The draws are the same
    each time.

    Args:
        above: what the number of each seed lies between, of the numerator.
        below: the same of the denominator.
        level: of the interval.

    Examples:
        >>> found = ratio_interval([Between(4, 4), Between(8, 8)], [Between(1, 2), Between(1, 2)])
        >>> found.low, found.high
        (2.0, 8.0)
    """
    rng = np.random.default_rng(0)
    rows, columns = (
        rng.integers(len(side), size=(RESAMPLES, len(side))) for side in (above, below)
    )

    def ratios(upper: Sequence[float], lower: Sequence[float]) -> np.ndarray:
        with np.errstate(divide="ignore"):  # a denominator that may be nil has no upper limit
            return np.array(upper)[rows].mean(1) / np.array(lower)[columns].mean(1)

    least = ratios([each.low for each in above], [each.high for each in below])
    most = ratios([each.high for each in above], [each.low for each in below])
    tail = (1 - level) / 2
    # An observed value, not one between two: infinite ones are not to be mixed with others.
    return Between(
        float(np.quantile(least, tail, method="lower")),
        float(np.quantile(most, 1 - tail, method="higher")),
    )
