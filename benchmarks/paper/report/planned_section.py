"""What was planned and is done: how many cells, why others are not, and core-hours."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence

from grid.cell import Cell
from report.planned import Planned
from report.runs import Run
from report.sections import Section
from report.tables import Number, Table, TableCell

_LONGEST = 160
"""Characters of an error in a table; all of it is in ``failure.json``."""


def planned_section(planned: Planned, runs: Sequence[Run]) -> Section:
    """A row for each method, task and label: the cells that are done, of those planned."""
    done = {run.folder.name: run for run in runs}
    groups: dict[tuple[str, str, int, str], list[Cell]] = defaultdict(list)
    for cell in planned.cells:
        groups[cell.task, cell.method, cell.samples or 0, cell.label].append(cell)
    rows: list[list[TableCell]] = []
    for (task, method, samples, label), cells in sorted(groups.items()):
        made = [done[cell.name] for cell in cells if cell.name in done]
        absent = [cell.name for cell in cells if cell.name not in done]
        name = f"{task}, {method}" + (f", {samples}" if samples else "")
        name += f" ({label})" if label != "default" else ""
        rows.append([name, _count(planned, len(made), absent), Number(_core_hours(made))])
    here = sum(cell.name in done for cell in planned.cells)
    hours = Number(_core_hours(runs))
    text = (
        f"{here} of {len(planned.cells)} planned cells are done, of all labels."
        if rows
        else "No plan: there is no `planned.json`, so that nobody sees which cells are missing."
    )
    if rows and len(runs) > here:
        text += f" {len(runs) - here} runs here were not planned."
    text += (
        f" All runs here took {hours} core-hours: the seconds of their phases that they recorded, "
        "times their threads. Those of failed cells are not known."
    )
    if rows:
        text += (
            " A cell that is done but could not be read is missing here, and named under *Left "
            "out*. Comparisons that were planned count in the families of tests, whether their "
            "cells are done or not."
        )
    header = ["task, method, real samples", "done of planned", "core-hours"]
    tables = {"Cells done of cells planned": Table("planned", header, rows)} if rows else {}
    return Section("Planned and done", text, tables)


def _core_hours(runs: Iterable[Run]) -> float:
    return sum(run.core_hours for run in runs)


def _count(planned: Planned, made: int, absent: Sequence[str]) -> str:
    """Such as ``7 of 10; 2 failed: ValueError: …, 1 missing``."""
    errors = [planned.failures[name] for name in absent if name in planned.failures]
    parts = []
    if errors:
        shown = (textwrap.shorten(error, _LONGEST) for error in dict.fromkeys(errors))
        parts.append(f"{len(errors)} failed: {'; '.join(shown)}".replace("|", "/"))
    if missing := len(absent) - len(errors):
        parts.append(f"{missing} missing")
    text = f"{made} of {made + len(absent)}"
    return f"{text}; {', '.join(parts)}" if parts else text
