"""The cells that grids were asked for, by system and task."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from grid.cell import Cell, CellFiles
from grid.planned import read_cells
from grid.status import read_failure
from measures import DEFAULT_SAMPLES
from report.paper_systems import PaperSystem, has_share


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
        return {n for n in set.union(*sides) if all({None, n} & side for side in sides)}

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
