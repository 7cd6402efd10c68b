"""The cells that grids were asked for: how many are done, why others are not, and core-hours."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from grid.cell import Cell, CellFiles
from grid.planned import read_cells
from grid.status import read_failure
from measures import DEFAULT_SAMPLES
from report.paper_systems import PaperSystem, has_share
from report.runs import Run
from report.sections import Section
from report.tables import Number, Table, TableCell

_LONGEST = 160
"""Characters of an error in a table; all of it is in ``failure.json``."""


def samples_of(cell: Cell) -> int | None:
    """The real samples of a planned cell; ``None`` where nobody knows before it is run.

    Examples:
        >>> samples_of(Cell("phihp", "pendulum", 0, 500)), samples_of(Cell("phihp", "pendulum", 0))
        (500, 1000)
        >>> samples_of(Cell("td3", "pendulum", 0)) is None
        True
    """
    if cell.samples is not None:
        return cell.samples
    return DEFAULT_SAMPLES.get(cell.task) if has_share(cell.method) else None


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
        cells = (cell for cell in self.cells if cell.label == label)
        return replace(self, cells=tuple(cells))

    def seeds(self, system: PaperSystem, task: str, samples: Collection[int] = ()) -> int:
        """The number of training seeds that were planned for a system on a task.

        Args:
            system: the system; a run of any of its methods would do.
            task: name of the task.
            samples: the numbers of real samples that are compared; by default, all.
        """
        counted = {None, *samples}  # of a cell whose number nobody knows, it may be any
        return len(
            {
                cell.seed
                for cell in self._cells(system, task)
                if not samples or samples_of(cell) in counted
            }
        )

    def whole_seeds(self, system: PaperSystem, task: str, samples: Collection[int]) -> int:
        """The number of training seeds that were planned at every one of these numbers."""
        planned: dict[int, set[int | None]] = defaultdict(set)
        for cell in self._cells(system, task):
            planned[cell.seed].add(samples_of(cell))
        return sum(None in found or {*samples} <= found for found in planned.values())

    def both(self, first: PaperSystem, second: PaperSystem, task: str) -> bool:
        """Whether a comparison of two systems on a task was planned."""
        return self.seeds(first, task) > 0 and self.seeds(second, task) > 0

    def at_equal_samples(
        self, first: PaperSystem, second: PaperSystem, task: str
    ) -> set[int | None]:
        """The numbers of real samples at which a comparison of two systems was planned.

        ``None`` is among them where both have a number of their own, which nobody knows before they
        are run.
        """
        sides = [
            {samples_of(cell) for cell in self._cells(system, task)} for system in (first, second)
        ]
        return {n for n in set.union(*sides) if all({None, n} & side for side in sides)} - (
            set() if all(None in side for side in sides) else {None}
        )

    def _cells(self, system: PaperSystem, task: str) -> list[Cell]:
        """Those of any of a system's methods on a task."""
        methods = {method for method, _ in system.sources}
        return [cell for cell in self.cells if cell.task == task and cell.method in methods]


def read_planned(directory: Path) -> Planned:
    """Read ``planned.json`` and all ``failure.json`` of a directory of runs.

    Raises:
        ConfigError: for a plan that cannot be read.
    """
    files = CellFiles(Cell("any", "any", 0), directory, directory)
    failures = {path.parent.name: read_failure(path)
                for path in sorted(directory.glob(f"*/{files.kept_failure.name}"))}  # fmt: skip
    return Planned(tuple(read_cells(files.planned, "runs").values()), failures)


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
