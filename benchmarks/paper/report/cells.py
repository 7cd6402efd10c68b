"""Cells of runs, a method and a task with a number of real samples, and their configurations."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from report.runs import Run

MIXED = "mixed"
"""What stands for a p-value or a verdict where :func:`is_mixed` says so of what is compared."""


def cells(runs: Iterable[Run]) -> dict[tuple[str, str, int], list[Run]]:
    """The runs by task, method and number of real samples, in this order."""
    found: dict[tuple[str, str, int], list[Run]] = defaultdict(list)
    for run in runs:
        found[run.task, run.method, run.samples].append(run)
    return dict(sorted(found.items()))


def configurations(cell: Iterable[Run]) -> int:
    """The number of configurations that the runs of a cell are of."""
    return len({run.configuration for run in cell})


def is_mixed(runs: Iterable[Run]) -> bool:
    """Whether these runs cannot be compared, for their settings or their episodes.

    A cell of several configurations has no number that counts, and two cells that were evaluated
    by different seeds, ``evaluate.first_seed``, have not met the same episodes.
    """
    runs = tuple(runs)
    several = any(configurations(cell) > 1 for cell in cells(runs).values())
    return several or len({run.first_seed for run in runs}) > 1
