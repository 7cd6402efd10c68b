"""The configuration of a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from grid.cell import Cell, CellFiles
from measures import PUBLISHED_SAMPLES
from phihp_torchrl.config import (
    ConfigError,
    check_count,
    check_not_negative,
    get_method,
    override_key,
    override_lines,
    parse_overrides,
)
from phihp_torchrl.evaluation import (
    EVALUATION_SEED,
    PROOF_SEED,
    REPORT_SEED,
    check_training_seed,
)
from phihp_torchrl.trainers import import_plugins

_FIRST_SEED = "evaluate.first_seed"
# A plan that is packaged where a core is idle would be timed by it in some cells and not in others.
_PROOF = ("evaluate.packaged=false",)


@dataclass(frozen=True)
class GridConfig:
    """A cell of the grid; ``config/grid.yaml`` mirrors it.

    Args:
        method: name of a registered method.
        task: name of a task.
        seed: of everything random in the run.
        share: real samples, as a share of the published number; ``None`` for the preset's own.
        label: name of the settings.
        overrides: settings that all cells have, as on the command line of ``phihp train``; the
            seed of the evaluation is not among them.
        allow_dirty: whether to run code that no commit has, as for a trial; its runs say so.
        proof: whether the episodes are those kept for the last proof, which each cell may play
            once. The code must be that of one commit, and the training seed one for reports.
        retry_failed: whether to try cells again that ended with an error.
        only_plan: whether to note the cell as planned and leave it at that.
        runs: directory of the runs in full.
        results: directory of what is kept of finished runs; ``None`` for results/runs with
            ``proof``, else results/trials, so that no trial is among the cells of the proof.
        claim_wait: seconds to wait for a cell that another process holds, as one that was killed
            may do for a moment.
        jobs: runs at a time, for the launcher ``joblib``.
        refresh: seconds between two looks at the grid; 0 for no table.
        method_overrides: settings that the grid gives a method besides its own, by method.
        plugins: Python files or modules to import, which register tasks, methods and the like.

    Raises:
        ConfigError: for a value that is unknown or out of range, by its key.
    """

    method: str
    task: str
    seed: int
    share: float | None = 0.5
    label: str = "default"
    overrides: tuple[str, ...] = ()
    allow_dirty: bool = False
    proof: bool = False
    retry_failed: bool = False
    only_plan: bool = False
    runs: str = "outputs/grid"
    results: str | None = None
    claim_wait: float = 10.0
    jobs: int = 2
    refresh: float = 2.0
    method_overrides: Mapping[str, tuple[str, ...]] = field(default_factory=dict, hash=False)
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        import_plugins(self.plugins)
        get_method(self.method)
        check_training_seed(self.seed)
        if self.share is not None and not self.share > 0:
            raise ConfigError("share", f"expected a positive number or null, got {self.share}.")
        check_count(self, "jobs")
        check_not_negative(self, "claim_wait", "refresh")
        if self.proof and self.allow_dirty:
            raise ConfigError("allow_dirty", "expected false with proof=true, got true.")
        if self.proof and self.seed < REPORT_SEED:
            raise ConfigError(
                "seed",
                f"expected {REPORT_SEED} or more with proof=true (smaller ones are for tuning), "
                f"got {self.seed}.",
            )
        for key, settings in (
            ("overrides", self.overrides),
            ("method_overrides", self.method_overrides.get(self.method, ())),
        ):
            _refuse_first_seed(key, settings)
        self.cell()

    @property
    def first_seed(self) -> int:
        """The seed of the cell's evaluation in the real world."""
        return PROOF_SEED if self.proof else EVALUATION_SEED

    def words(self) -> list[str]:
        """The settings of the cell's run, but for its place, as on a command line."""
        cell, samples_key = self.cell(), get_method(self.method).samples_key
        lines = [f"task={cell.task}", f"method={cell.method}", f"seed={cell.seed}"]
        lines += ["progress=false", *override_lines({"plugins": self.plugins})]
        if self.proof:
            lines += [f"{_FIRST_SEED}={self.first_seed}", *_PROOF]
        if cell.samples is not None:
            lines.append(f"{samples_key}={cell.samples}")
        return [*lines, *self.method_overrides.get(self.method, ()), *self.overrides]

    def cell(self) -> Cell:
        """The cell.

        Raises:
            ConfigError: if ``share`` is of a task that has no published number of samples.
        """
        samples = None
        if self.share is not None and get_method(self.method).samples_key is not None:
            if self.task not in PUBLISHED_SAMPLES:
                raise ConfigError(
                    "share",
                    f"expected null for {self.task!r}, of which no number of samples is "
                    f"published, got {self.share}.",
                )
            samples = round(PUBLISHED_SAMPLES[self.task] * self.share)
        return Cell(self.method, self.task, self.seed, samples, self.label)

    def files(self, root: Path) -> CellFiles:
        """The cell's files; relative directories are in ``root``."""
        results = self.results or ("results/runs" if self.proof else "results/trials")
        return CellFiles(self.cell(), root / self.runs, root / results)


def _refuse_first_seed(key: str, settings: Sequence[str]) -> None:
    """Refuse settings that choose the episodes of the evaluation."""
    section, name = _FIRST_SEED.split(".")
    for line in parse_overrides(settings):
        value = line.value() if override_key(line) == section else None
        if override_key(line) == _FIRST_SEED or (isinstance(value, Mapping) and name in value):
            raise ConfigError(
                key,
                f"expected no {_FIRST_SEED} among them, got {line.input_line!r}: use proof=true "
                "for the episodes of the last proof, which only it may play.",
            )
