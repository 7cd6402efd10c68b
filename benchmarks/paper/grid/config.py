"""The configuration of a grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from grid.cell import Cell, CellFiles
from measures import PUBLISHED_SAMPLES
from phihp_torchrl.evaluation import check_training_seed
from phihp_torchrl.ranges import check_count, check_not_negative


@dataclass(frozen=True)
class MethodConfig:
    """How a method is run.

    Args:
        recipe: the recipe whose configuration it is.
        overrides: what makes the recipe this method.
        samples_key: the key that takes the number of real samples; ``None`` for a method that
            keeps its own budget whatever ``share`` is.
    """

    recipe: str
    overrides: tuple[str, ...] = ()
    samples_key: str | None = None


@dataclass(frozen=True)
class GridConfig:
    """A cell of the grid; ``config/grid.yaml`` mirrors it.

    Args:
        method: one of ``methods``.
        task: name of a task.
        seed: of everything random in the run.
        share: real samples, as a share of the published number; ``None`` for the recipe's own.
        label: name of the settings.
        overrides: settings that all cells have, as on the recipe's command line.
        retry_failed: whether to try cells again that ended with an error.
        runs: directory of the runs in full.
        results: directory of what is kept of finished runs.
        claim_wait: seconds to wait for a cell that another process holds, as one that was killed
            may do for a moment.
        jobs: runs at a time, for the launcher ``joblib``.
        refresh: seconds between two looks at the grid; 0 for no table.
        methods: how each method is run.

    Raises:
        ValueError: for a value that is unknown or out of range, by its key.
    """

    method: str
    task: str
    seed: int
    share: float | None = 0.5
    label: str = "default"
    overrides: tuple[str, ...] = ()
    retry_failed: bool = False
    runs: str = "outputs/grid"
    results: str = "results/runs"
    claim_wait: float = 10.0
    jobs: int = 2
    refresh: float = 2.0
    methods: Mapping[str, MethodConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.method not in self.methods:
            raise ValueError(
                f"method: expected one of {sorted(self.methods)}, got {self.method!r}."
            )
        check_training_seed(self.seed)
        if self.share is not None and not self.share > 0:
            raise ValueError(f"share: expected a positive number or null, got {self.share}.")
        check_count(self, "jobs")
        check_not_negative(self, "claim_wait", "refresh")
        self.cell()

    @property
    def how(self) -> MethodConfig:
        """How the cell's method is run."""
        return self.methods[self.method]

    def cell(self) -> Cell:
        """The cell.

        Raises:
            ValueError: if ``share`` is of a task that has no published number of samples.
        """
        samples = None
        if self.share is not None and self.how.samples_key is not None:
            if self.task not in PUBLISHED_SAMPLES:
                raise ValueError(
                    f"share: expected null for {self.task!r}, of which no number of samples is "
                    f"published, got {self.share}."
                )
            samples = round(PUBLISHED_SAMPLES[self.task] * self.share)
        return Cell(self.method, self.task, self.seed, samples, self.label)

    def files(self, root: Path) -> CellFiles:
        """The cell's files; relative directories are in ``root``."""
        return CellFiles(self.cell(), root / self.runs, root / self.results)
