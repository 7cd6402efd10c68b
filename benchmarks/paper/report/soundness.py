"""Whether the runs of a cell fit together: one configuration, committed code, fresh seeds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from report.runs import Run
from report.sections import Section
from report.tables import Table, TableCell

REPORT_SEED = 100
"""Smaller training seeds are for tuning; a report is on this and later ones."""


def soundness(runs: Iterable[Run]) -> Section:
    """A row for each cell whose runs do not fit together, or that no commit can make again."""
    cells: dict[tuple[str, str, int], list[Run]] = defaultdict(list)
    for run in runs:
        cells[run.task, run.method, run.samples].append(run)
    rows: list[list[TableCell]] = []
    for (task, method, samples), group in sorted(cells.items()):
        configurations = {run.configuration for run in group}
        dirty = sorted(run.seed for run in group if run.commit.endswith("+"))
        tuned = sorted(run.seed for run in group if run.seed < REPORT_SEED)
        if len(configurations) > 1 or dirty or tuned:
            rows.append(
                [
                    f"{task}, {method}, {samples}",
                    str(len(group)),
                    str(len(configurations)),
                    ", ".join(map(str, dirty)) or "–",
                    ", ".join(map(str, tuned)) or "–",
                ]
            )
    text = (
        "Seeds of a cell should be of one configuration, of committed code, and from "
        f"{REPORT_SEED} on, which no choice of a default has seen. "
        + (f"That is not so in {len(rows)} of {len(cells)} cells." if rows else "That is so.")
    )
    header = ["cell, real samples", "runs", "configurations", "seeds of changed code"]
    header += [f"seeds below {REPORT_SEED}"]
    tables = {"Cells": Table("soundness", header, rows)} if rows else {}
    return Section("Soundness", text, tables)
