"""A cell of a grid of runs, and where its files are."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from phihp_torchrl.config import ConfigError

DEFAULT_METHOD = "phihp"
"""The method whose name the cells' names leave out."""

_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True)
class Cell:
    """One method on one task with one seed.

    Args:
        method: name of the method.
        task: name of the task.
        seed: seed of everything random in the run.
        samples: real samples it may use, where the grid says so; else ``None``.
        label: name of its settings, so that a grid can have several.

    Raises:
        ConfigError: for a name that cannot be part of a file's.

    Examples:
        >>> Cell("phihp", "acrobot", 0, 2500).name
        'acrobot-default-n2500-seed0'
        >>> Cell("td3", "acrobot", 1).name
        'acrobot-td3-default-seed1'
    """

    method: str
    task: str
    seed: int
    samples: int | None = None
    label: str = "default"

    def __post_init__(self) -> None:
        for key in ("method", "task", "label"):
            value = getattr(self, key)
            if not _FILE_NAME.fullmatch(value):
                raise ConfigError(key, f"expected letters, digits, '.', '_', '-', got {value!r}.")

    @property
    def name(self) -> str:
        """The name of its directory."""
        parts = [self.task]
        if self.method != DEFAULT_METHOD:
            parts.append(self.method)
        parts.append(self.label)
        if self.samples is not None:
            parts.append(f"n{self.samples}")
        return "-".join([*parts, f"seed{self.seed}"])


@dataclass(frozen=True)
class CellFiles:
    """The files of a cell.

    Args:
        cell: the cell.
        runs: directory of all runs in full, with checkpoints.
        results: directory of what is kept of finished runs.
    """

    cell: Cell
    runs: Path
    results: Path

    @property
    def run(self) -> Path:
        """The run directory."""
        return self.runs / self.cell.name

    @property
    def log(self) -> Path:
        """What happened to the cell, and its warnings."""
        return self.runs / f"{self.cell.name}.log"

    @property
    def lock(self) -> Path:
        """Locked by the process that works on the cell."""
        return self.runs / f"{self.cell.name}.lock"

    @property
    def failure(self) -> Path:
        """The error that ended the cell, if one did."""
        return self.runs / f"{self.cell.name}.failure.json"

    @property
    def kept(self) -> Path:
        """What is kept of the finished run: small text files."""
        return self.results / self.cell.name

    @property
    def evaluation(self) -> Path:
        """The last file to be kept: a cell that has it is done."""
        return self.kept / "evaluation.json"

    @property
    def kept_failure(self) -> Path:
        """What is kept of a cell that failed: its error in short."""
        return self.kept / "failure.json"

    @property
    def planned(self) -> Path:
        """All cells that grids with these results were asked for, by their names."""
        return self.results / "planned.json"
