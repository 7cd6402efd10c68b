"""Cells of runs, a method and a task with a number of real samples, and their configurations."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from report.runs import Run

MIXED = "mixed"
"""What stands for a p-value or a verdict where a cell has runs of several configurations."""


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
    """Whether any cell of these runs is of several configurations, so that no number of it counts.

    The seed of the evaluation, ``evaluate.first_seed``, is part of a configuration.
    """
    return any(configurations(cell) > 1 for cell in cells(runs).values())
