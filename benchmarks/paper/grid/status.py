"""What has become of a cell, read from its files alone."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from grid.cell import CellFiles
from grid.claim import is_claimed
from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import RunDirectory


class Status(Enum):
    """What a cell can be."""

    DONE = "done"
    FAILED = "failed"
    RUNNING = "running"
    STOPPED = "cut off"
    WAITING = "waiting"


@dataclass(frozen=True)
class CellState:
    """The status of a cell, with a few words more.

    Args:
        status: its status.
        detail: the return of one that is done, how far one is that runs, the error of a failed one.
    """

    status: Status
    detail: str = ""


def look(files: CellFiles) -> CellState:
    """The state of a cell now. It locks nothing that a worker would wait for long."""
    if is_done(files):
        return CellState(Status.DONE, _earned(files.evaluation))
    if is_claimed(files.lock):
        return CellState(Status.RUNNING, _how_far(files.run / "metrics.csv"))
    if files.failure.is_file():
        return CellState(Status.FAILED, read_failure(files.failure))
    if (files.run / "config.yaml").is_file():
        return CellState(Status.STOPPED, _how_far(files.run / "metrics.csv"))
    return CellState(Status.WAITING)


def is_done(files: CellFiles) -> bool:
    """Whether what is kept of a finished run is whole, by its last file.

    One that was torn, as when a disk was full, is not done: it is kept again.
    """
    try:
        return RunDirectory(files.kept).read_evaluation() is not None
    except ConfigError:
        return False


def read_failure(path: Path) -> str:
    """The error that a worker left behind, in one line."""
    try:
        return str(json.loads(path.read_text())["error"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"{path} cannot be read: {error}"


def _earned(evaluation: Path) -> str:
    """The mean return of a finished run, of its planner if it has one."""
    try:
        results = json.loads(evaluation.read_text())
        return f"{float(next(iter(results.values()))['return_mean']):.1f}"
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration):
        return "unreadable"


def _how_far(metrics: Path) -> str:
    """The phase and the seconds of the last whole row."""
    try:
        with metrics.open(newline="") as file:
            *_, last = csv.DictReader(file)
        return f"{last['phase']}, {float(last['seconds']):.0f} s"
    except (OSError, ValueError, KeyError, TypeError):
        return ""  # no row yet, or one half written
