"""From files of any known format to recordings in the units of a system."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings.columns import (
    Column,
    choose_columns,
    looks_like_degrees,
    read_columns,
)
from phihp_torchrl.recordings.formats import find_files, read_tables
from phihp_torchrl.recordings.recording import Recording
from phihp_torchrl.recordings.stretches import Report, Samples, cut
from phihp_torchrl.recordings.tables import Table
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)

_TURN = 2.0 * math.pi
_GAP = 1.5


@dataclass(frozen=True)
class RecordedData:
    """What :func:`read_recordings` has read.

    Args:
        recordings: the uninterrupted stretches, in the order of the files.
        counts: ``rows`` that were read and ``samples`` that are used, and how often a row had a
            ``missing_time``, ``missing_command`` or ``missing_input``, missed a measured state
            (``missing_state``), had the time of the row before (``repeated_time``) or an earlier
            one (``time_back``), came after a gap (``lost``), had too few or too many cells
            (``ragged``) or an ``infinite`` value, or was left ``alone`` between two cuts.
        notes: a sentence for each of these and each file, with file, line and column.

    Examples:
        >>> import torch
        >>> time = torch.arange(3, dtype=torch.float64)
        >>> data = RecordedData([Recording(time, torch.zeros(3, 2), torch.zeros(3, 1))])
        >>> len(data.recordings), data.transitions
        (1, 2)
    """

    recordings: list[Recording]
    counts: Mapping[str, int] = field(default_factory=dict, hash=False)
    notes: tuple[str, ...] = ()

    @property
    def transitions(self) -> int:
        """Number of pairs of consecutive samples."""
        return sum(len(recording) - 1 for recording in self.recordings)


def read_recordings(
    task: Task | System,
    files: str | Path | Sequence[str | Path],
    columns: Mapping[str, str | Mapping[str, Any] | Column] | None = None,
    *,
    time_step: float | None = None,
    gap: float = _GAP,
    decimal: str = ".",
) -> RecordedData:
    """Read recorded episodes from files, in the units of a system.

    A row without a time is left out. Where it was, where the clock says that rows are lost, and
    after a row without a command or an input, a recording ends and a new one begins, so that
    nothing is ever bridged. A row that misses a measured state is kept, with NaN there. Infinite
    values count as missing. An angle whose values jump by a turn is continued over the jump within
    a recording. Everything of that kind is counted and logged. A text that is no number is an
    error.

    Args:
        task: the task, or the system alone.
        files: files, patterns (``logs/*.csv``), folders, or ``minari:`` and the name or path of a
            data set: CSV, Parquet (``.parquet``), HDF5 (``.h5``) and Minari. Each file begins a new
            episode.
        columns: for each state, action and input, and for ``time`` and ``episode``, the name of its
            column or the fields of a :class:`Column`. What is not named has the column of its own
            name. A velocity without a column is not measured; it is NaN in all samples.
        time_step: seconds between rows, where there are no time stamps.
        gap: how many times the median an interval must be to mean that rows are lost, where the
            clock is about regular otherwise.
        decimal: the sign before decimals in text, ``"."`` or ``","``.

    Returns:
        The recordings, and counts and sentences about what was left out.

    Raises:
        ConfigError: for files that are not there, unreadable or empty; a column that a file does
            not have; a text that is no number (naming file, line and column); a time column that is
            no clock; a library that is not installed.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl import get_task
        >>> log = Path(tempfile.mkdtemp()) / "swing.csv"
        >>> lines = ["ms,angle,torque", "0,0,1", "50,2,1", "100,4,1", "150,nan,1", "200,8,1"]
        >>> _ = log.write_text(chr(10).join(lines))
        >>> columns = {"time": {"column": "ms", "unit": "ms"}, "torque": "torque"}
        >>> columns["theta"] = {"column": "angle", "unit": "deg"}
        >>> data = read_recordings(get_task("pendulum"), log, columns)
        >>> data.recordings[0].state[:, 0].rad2deg().round().tolist()
        [0.0, 2.0, 4.0, nan, 8.0]
        >>> data.counts["missing_state"], data.recordings[0].measured.tolist()
        (1, [True, False])
    """
    system = task.system if isinstance(task, Task) else task
    if time_step is not None and not 0 < time_step < math.inf:
        raise ConfigError("time_step", f"expected a positive number of seconds, got {time_step}.")
    if not gap > 1.0:
        raise ConfigError("gap", f"expected a number above 1, got {gap}.")
    if decimal not in (".", ","):
        raise ConfigError("decimal", f"expected '.' or ',', got {decimal!r}.")
    given = read_columns(system, columns or {})
    if time_step is not None and "time" in given:
        raise ConfigError("time_step", "expected none where columns.time has time stamps.")
    report = Report()
    recordings: list[Recording] = []
    needed = _needed(system, given, time_step)
    for name in find_files(files):
        before, seen = report.counts.copy(), len(report.notes)
        for table in read_tables(name, needed, decimal=decimal):
            episode = recordings[-1].episode + 1 if recordings else 0
            samples = _samples(system, given, table, report, time_step)
            recordings += cut(samples, table, report, episode=episode, gap=gap)
        _tell(name, report, before, report.notes[seen:])
    if not recordings:
        raise ConfigError(
            "files",
            "no two consecutive rows can be used. " + " ".join(report.notes),
        )
    return RecordedData(recordings, dict(report.counts), tuple(report.notes))


def _needed(system: System, given: Mapping[str, Column], time_step: float | None) -> list[str]:
    """Columns without which a group of a file is no episode."""
    optional = {"episode", *system.velocity_of.values()}
    names = [*system.state_names, *system.action_names, *system.input_names]
    names += ["time"] if time_step is None else []
    kept = {name: Column(name) for name in names if name not in optional} | dict(given)
    return [each for column in kept.values() for each in column.names]


def _samples(
    system: System,
    given: Mapping[str, Column],
    table: Table,
    report: Report,
    time_step: float | None,
) -> Samples:
    chosen = choose_columns(system, given, table, clock=time_step is None)
    count = len(table)
    values: dict[str, NDArray[Any]] = {}
    for name, column in chosen.items():
        if name != "episode":
            values[name] = column.read(table)
        if name in system.angles and looks_like_degrees(column, values[name]):
            report.notes.append(
                f"{table.source}, column {column.column!r}: the values of {name} look like "
                f"degrees; say columns.{name}={{column: {column.column}, unit: deg}}, or unit: rad."
            )
            report.counts["looks_like_degrees"] += 1
    report.add(
        "ragged",
        np.array(table.ragged, dtype=np.int64),
        table,
        "rows with too few or too many cells; left out.",
    )
    for each, infinite in table.infinite.items():
        report.counts["infinite"] += infinite
        report.notes.append(
            f"{table.source}, column {each!r}: {infinite} infinite values, which count as missing."
        )
    unmeasured = [name for name in system.state_names if name not in chosen]
    for name in unmeasured:
        values[name] = np.full(count, np.nan)
    inputs = [values[name] for name in system.input_names]
    time = values["time"] if time_step is None else time_step * np.arange(count)
    if time_step is not None and len(table.ragged):
        time[np.array(table.ragged)] = np.nan
    return Samples(
        time=time,
        state=np.stack([values[name] for name in system.state_names], -1),
        action=np.stack([values[name] for name in system.action_names], -1),
        inputs=np.array(inputs).reshape(len(inputs), count).T,  # without any, zero columns
        labels=table.labels(chosen["episode"].names[0]) if "episode" in chosen else None,
        wrapped=[i for i in system.angle_indices if _wraps(values[system.state_names[i]])],
    )


def _wraps(angle: NDArray[Any]) -> bool:
    """Whether an angle stays within a turn and jumps across it; others count on."""
    known = angle[np.isfinite(angle)]
    if len(known) < 2:
        return False
    within = known.max() - known.min() <= _TURN * (1.0 + 1e-3)
    return bool(within and (np.abs(np.diff(known)) > math.pi).any())


def _tell(name: str, report: Report, before: Mapping[str, int], notes: Sequence[str]) -> None:
    """Log what was read from a file, as a warning where something was left out."""
    rows, used = (report.counts[key] - before.get(key, 0) for key in ("rows", "samples"))
    sentence = f"{name}: {used} of {rows} rows are used."
    for note in notes[:20]:
        sentence += f"\n  {note}"
    if len(notes) > 20:
        sentence += f"\n  ... and {len(notes) - 20} more; RecordedData.notes has all."
    _log.log(logging.WARNING if notes else logging.INFO, "%s", sentence)
