"""Whether the runs of a cell fit together: one configuration, one commit, fresh seeds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from phihp_torchrl.evaluation import REPORT_SEED
from report.cells import cells, configurations
from report.runs import Run
from report.sections import Section
from report.tables import Table, TableCell


def soundness(runs: Iterable[Run]) -> Section:
    """A row for each cell whose runs do not fit together, or that no commit can make again."""
    by_cell = cells(runs)
    rows: list[list[TableCell]] = []
    for (task, method, samples), group in by_cell.items():
        kinds, commits = configurations(group), {commit for run in group for commit in run.commits}
        dirty = [run.seed for run in group if run.dirty]
        unknown = [run.seed for run in group if run.dirty is None]
        tuned = [run.seed for run in group if run.seed < REPORT_SEED]
        if max(kinds, len(commits)) > 1 or dirty or unknown or tuned:
            rows.append(
                [
                    f"{task}, {method}, {samples}",
                    str(len(group)),
                    str(kinds),
                    ", ".join(sorted(commits)),
                    *map(_seeds, (dirty, unknown, tuned)),
                ]
            )
    text = (
        "Seeds of a cell should be of one configuration, of one commit in all their sessions, of "
        f"code without other changes, and from {REPORT_SEED} on, which no choice of a default has "
        "seen. "
        + _verdict(len(rows), len(by_cell))
        + " Comparisons of cells with several configurations get no verdict."
    )
    header = ["cell, real samples", "runs", "configurations", "commits", "seeds of changed code"]
    header += ["seeds of code that may have been changed", f"seeds below {REPORT_SEED}"]
    tables = {"Cells": Table("soundness", header, rows)} if rows else {}
    return Section("Soundness", text, tables)


def _verdict(bad: int, cells: int) -> str:
    if not cells:
        return "There are no runs."
    return f"That is not so in {bad} of {cells} cells." if bad else "That is so."


def _seeds(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, sorted(seeds))) or "–"
