"""The cells that grids were asked for: how many are done, why others are not, and core-hours."""

from __future__ import annotations

import json
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from grid.cell import Cell, CellFiles
from grid.status import read_failure
from phihp_torchrl.config import ConfigError
from report.paper_systems import PaperSystem
from report.runs import Run
from report.sections import Section
from report.tables import Number, Table, TableCell

_LONGEST = 160
"""Characters of an error in a table; all of it is in ``failure.json``."""


@dataclass(frozen=True)
class Planned:
    """What grids were asked for, and which of it failed.

    Args:
        cells: the planned cells; none where no grid has noted any.
        failures: errors of cells that failed, by their names.
    """

    cells: tuple[Cell, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)

    def of(self, label: str) -> Planned:
        """The cells with one label."""
        return replace(self, cells=tuple(cell for cell in self.cells if cell.label == label))

    def seeds(self, system: PaperSystem, task: str, runs: Iterable[Run] = ()) -> int:
        """The number of training seeds that were planned for a system on a task.

        Args:
            system: the system; a run of any of its methods would do.
            task: name of the task.
            runs: those that are compared; only cells of their numbers of samples count then.
        """
        methods = {method for method, _ in system.sources}
        numbers = {run.samples for run in runs}
        return len(
            {
                cell.seed
                for cell in self.cells
                if (cell.task == task and cell.method in methods)
                and (not numbers or cell.samples is None or cell.samples in numbers)
            }
        )

    def both(self, first: PaperSystem, second: PaperSystem, task: str) -> bool:
        """Whether a comparison of two systems on a task was planned."""
        return self.seeds(first, task) > 0 and self.seeds(second, task) > 0


def read_planned(directory: Path) -> Planned:
    """Read ``planned.json`` and all ``failure.json`` of a directory of runs.

    Raises:
        ConfigError: for a plan that cannot be read; without it, every missing run would be lost.
    """
    files = CellFiles(Cell("any", "any", 0), directory, directory)
    failures = {path.parent.name: read_failure(path)
                for path in sorted(directory.glob(f"*/{files.kept_failure.name}"))}  # fmt: skip
    if not files.planned.is_file():
        return Planned((), failures)
    try:
        cells = tuple(Cell(**cell) for cell in json.loads(files.planned.read_text()).values())
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ConfigError(
            "runs", f"expected a description of each cell in {files.planned}, got {error}."
        ) from error
    return Planned(cells, failures)


def planned_section(planned: Planned, runs: Sequence[Run]) -> Section:
    """A row for each method and task: the cells that are done, of those that were planned."""
    done = {run.folder.name: run for run in runs}
    groups: dict[tuple[str, str, int], list[Cell]] = defaultdict(list)
    for cell in planned.cells:
        groups[cell.task, cell.method, cell.samples or 0].append(cell)
    rows: list[list[TableCell]] = []
    for (task, method, samples), cells in sorted(groups.items()):
        made = [done[cell.name] for cell in cells if cell.name in done]
        absent = [cell.name for cell in cells if cell.name not in done]
        name = f"{task}, {method}" + (f", {samples}" if samples else "")
        rows.append([name, _count(planned, len(made), absent), Number(_core_hours(made))])
    here = sum(cell.name in done for cell in planned.cells)
    hours = Number(_core_hours(runs))
    text = (
        f"{here} of {len(planned.cells)} planned cells are done."
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
