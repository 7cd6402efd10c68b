"""Differences between systems, with intervals over training seeds, and tests of whole families."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from scipy import stats

FEWEST_SEEDS = 3
"""With fewer values on either side there is no p-value."""


@dataclass(frozen=True)
class Difference:
    """A difference of means, a value for each training seed.

    Args:
        mean: the difference.
        low: lower end of its 95 % interval; NaN with fewer than two values on either side, and
            where no value varies.
        high: upper end.
        p: two-sided p-value of no difference, or of the one asked about; NaN with fewer than
            :data:`FEWEST_SEEDS` values on either side.
        seeds: number of values on either side.
        mixed: whether values of one side are of several configurations, or the two sides of other
            episodes; there is no p-value then.
    """

    mean: float
    low: float
    high: float
    p: float
    seeds: tuple[int, int]
    mixed: bool = False

    @property
    def varies_nowhere(self) -> bool:
        """Whether all seeds of a side agree, on both sides, and there are enough of them."""
        return min(self.seeds) >= FEWEST_SEEDS and math.isnan(self.low)

    def within(self, margin: float) -> bool:
        """Whether the whole interval lies within ±``margin``: the two are equivalent by it.

        Fewer than :data:`FEWEST_SEEDS` values on either side are equivalent to nothing. Where none
        varies there is no interval, and the difference itself must lie within.

        Examples:
            >>> same, apart = [500.0] * 10, [400.0] * 10
            >>> [gap.within(5.0) for b in (same, apart) if (gap := difference(same, b))]
            [True, False]
        """
        if min(self.seeds) < FEWEST_SEEDS:
            return False
        if self.varies_nowhere:
            return abs(self.mean) < margin
        return self.low > -margin and self.high < margin


def difference(
    a: Sequence[float], b: Sequence[float], level: float = 0.95, *, least: float = 0.0
) -> Difference | None:
    """``mean(a) − mean(b)`` of independent seeds, by Welch's t (unequal variances).

    Args:
        a: a value for each seed.
        b: a value for each seed of the other.
        level: of the interval.
        least: the p-value is of the difference being this: minus a margin, where one asks
            whether ``a`` is worse by no more.

    Returns:
        ``None`` where one of them has no value.

    Examples:
        >>> found = difference([1.0, 2.0, 3.0], [3.0, 5.0, 7.0])
        >>> f"{found.mean} [{found.low:.2f}, {found.high:.2f}], p = {found.p:.2f}"
        '-3.0 [-7.16, 1.16], p = 0.10'
    """
    if not a or not b:
        return None
    mean, seeds = fmean(a) - fmean(b), (len(a), len(b))
    if min(seeds) < 2 or (len({*a}) == 1 and len({*b}) == 1):
        return Difference(mean, math.nan, math.nan, math.nan, seeds)
    low, high = stats.ttest_ind(a, b, equal_var=False).confidence_interval(level)
    moments = [fmean(a) - least, stdev(a), len(a), fmean(b), stdev(b), len(b)]
    test = stats.ttest_ind_from_stats(*moments, equal_var=False)
    p = float(test.pvalue) if min(seeds) >= FEWEST_SEEDS else math.nan
    return Difference(mean, float(low), float(high), p, seeds)


def mean_of_seeds(values: Sequence[float], level: float = 0.95) -> Difference | None:
    """Mean over training seeds with its interval by Student's t, such as of paired differences.

    Episodes of one seed share their agent, so that a seed counts once, however many they are.

    Args:
        values: the mean of each seed, or its mean difference, of which the p-value is.
        level: of the interval.

    Examples:
        >>> found = mean_of_seeds([1.0, 2.0, 3.0])
        >>> f"{found.mean} [{found.low:.2f}, {found.high:.2f}], p = {found.p:.2f}"
        '2.0 [-0.48, 4.48], p = 0.07'
    """
    if not values:
        return None
    mean, seeds = fmean(values), (len(values), len(values))
    if len(values) < 2 or len({*values}) == 1:
        return Difference(mean, math.nan, math.nan, math.nan, seeds)
    test = stats.ttest_1samp(values, 0.0)
    low, high = test.confidence_interval(level)
    p = float(test.pvalue) if len(values) >= FEWEST_SEEDS else math.nan
    return Difference(mean, float(low), float(high), p, seeds)


def mean_and_half(values: Sequence[float]) -> str:
    """The mean over training seeds ± half of its 95 % interval, in words (:func:`mean_of_seeds`).

    Examples:
        >>> mean_and_half([1.0, 2.0, 3.0]), mean_and_half([-1.0])
        ('2.0 ± 2.5', '−1.0 one seed')
    """
    found = mean_of_seeds(values)
    if found is None:
        return "–"
    half = (found.high - found.low) / 2
    spread = "one seed" if len(values) < 2 else f"± {0.0 if math.isnan(half) else half:.1f}"
    return f"{found.mean:.1f} {spread}".replace("-", "−")


def holm(p_values: Sequence[float], family: int = 0) -> list[float]:
    """Holm's adjustment of a family of p-values; NaN stays NaN and is not counted.

    Args:
        p_values: those that there are.
        family: the number of tests that were planned, where it is larger: one that could not be
            done counts as the least significant.

    A family in which all differences are nil has some adjusted value below 0.05 in at most 5 % of
    cases (Holm, 1979, Scandinavian Journal of Statistics 6).

    Examples:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]
        >>> holm([0.01], family=4)
        [0.04]
    """
    order = sorted(
        (i for i, p in enumerate(p_values) if not math.isnan(p)), key=p_values.__getitem__
    )
    size = max(family, len(order))
    adjusted, largest = list(p_values), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (size - rank) * p_values[i]))
        adjusted[i] = largest
    return adjusted
