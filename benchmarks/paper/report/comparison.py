"""Comparisons of systems as all tables make them, and their cells in a row."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from measures import Difference, difference
from report.cells import MIXED, is_mixed
from report.results import Score
from report.runs import Run
from report.tables import Number, TableCell


def unless_mixed(found: Difference, runs: Iterable[Run]) -> Difference:
    """The difference, without a p-value if its runs cannot be compared."""
    return replace(found, p=math.nan, mixed=True) if is_mixed(runs) else found


def compared(
    ours: Sequence[Score], theirs: Sequence[Score], *, least: float = 0.0
) -> Difference | None:
    """The difference of mean returns; ``None`` where a side has no run.

    Args:
        ours: a score for each seed.
        theirs: those that are taken off.
        least: what the p-value asks about (:func:`~measures.difference`).
    """
    a, b = ([score.mean for score in side] for side in (ours, theirs))
    found = difference(a, b, least=least)
    return found and unless_mixed(found, [score.run for score in (*ours, *theirs)])


def numbers(found: Difference, p: float, digits: int) -> list[TableCell]:
    """The difference, the ends of its interval, its adjusted p-value: the cells of a row.

    Args:
        found: the difference.
        p: its p-value, adjusted for the family that it is tested in.
        digits: decimals of the difference and its ends.
    """
    ends: list[TableCell] = [
        "–" if math.isnan(v) else Number(v, digits, fixed=True) for v in (found.low, found.high)
    ]
    shown: TableCell = MIXED if found.mixed else "–" if math.isnan(p) else Number(p, 2)
    return [Number(found.mean, digits, fixed=True), *ends, shown]
