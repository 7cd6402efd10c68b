"""Cut the rows of a table into stretches that nothing interrupts, and count what is left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings.recording import Recording
from phihp_torchrl.recordings.tables import Table

_REGULAR = 0.9
"""A clock is about regular if this share of its intervals is near their median."""

_TOO_MANY = 0.1
"""The largest share of rows whose time goes back or stands still; with more, time is no clock."""


@dataclass
class Report:
    """What was read from all files: counts, and sentences about what was found.

    Args:
        counts: how often each thing was met.
        notes: sentences for people, each with the place where it was first met.
    """

    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def add(self, what: str, rows: NDArray[Any], table: Table, sentence: str) -> None:
        """Count rows, and say where the first of them is."""
        if len(rows):
            self.counts[what] += len(rows)
            self.notes.append(f"{table.place(int(rows[0]))}: {len(rows)} {sentence}")


@dataclass(frozen=True)
class Samples:
    """The rows of a table in the units of a system.

    Args:
        time: seconds, ``[rows]``; NaN where it is missing.
        state: ``[rows, n]``; NaN where a component is missing.
        action: ``[rows, m]``; NaN where a command is missing.
        inputs: ``[rows, k]``; NaN where an input is missing.
        labels: what tells episodes apart, ``[rows]``, or ``None``.
        wrapped: indices of the angles whose values jump by a turn.
    """

    time: NDArray[Any]
    state: NDArray[Any]
    action: NDArray[Any]
    inputs: NDArray[Any]
    labels: Sequence[Any] | None
    wrapped: Sequence[int]


def cut(
    samples: Samples, table: Table, report: Report, *, episode: int, gap: float
) -> list[Recording]:
    """Cut samples where an episode, the clock, commands, inputs or the rows are interrupted.

    Args:
        samples: the rows.
        table: where they are from.
        report: what is left out is counted here.
        episode: number of the first episode.
        gap: an interval longer than this many medians means that rows are lost.

    Raises:
        ConfigError: for a time column that is no clock.
    """
    report.counts["rows"] += len(samples.time)
    timed = np.isfinite(samples.time)
    report.add("missing_time", np.flatnonzero(~timed), table, "rows without a time; left out.")
    rows = np.flatnonzero(timed)
    # A row after one that was left out for its missing time does not follow the row before that.
    broken = np.diff(rows, prepend=rows[0] - 1 if len(rows) else 0) > 1
    rows, broken = _drop_repeated(samples, table, report, rows, broken)
    time = samples.time[rows]
    step = np.diff(time, prepend=np.nan)
    started = np.zeros(len(rows), dtype=bool)
    if samples.labels is not None:
        labels = [samples.labels[int(i)] for i in rows]
        started[1:] = [a != b for a, b in zip(labels[1:], labels[:-1], strict=True)]
    back = (step < 0) & ~started
    report.add("time_back", rows[back], table, "times that go back; a new episode begins at each.")
    if back.sum() > max(1, _TOO_MANY * len(rows)):
        raise ConfigError(
            "columns.time",
            f"{table.source}: {int(back.sum())} of {len(rows)} times go back; expected the rows in "
            "the order of their times.",
        )
    started |= back
    step[started] = np.nan
    lost = _lost(step, table, report, gap)
    report.add(
        "lost",
        rows[lost],
        table,
        f"intervals over {gap:g} medians, where rows are lost; cut there.",
    )
    # What acts is not known until the next row, but the state of a row without it is still good.
    no_command = ~np.isfinite(samples.action).all(-1)[rows]
    report.add("missing_command", rows[no_command], table, "rows without a command; cut there.")
    no_input = ~np.isfinite(samples.inputs).all(-1)[rows]
    report.add("missing_input", rows[no_input], table, "rows without an input; cut there.")
    silent = no_command | no_input
    after_silent = np.concatenate([[False], silent[:-1]]) if len(rows) else silent
    absent = ~np.isfinite(samples.state)[rows]
    partly = (absent & ~absent.all(0)).any(-1)  # of components that are measured at all
    report.add(
        "missing_state", rows[partly], table, "rows that miss a measured state; kept without it."
    )
    ends = broken | started | lost | after_silent
    if len(ends):
        ends[0] = True
    numbers = episode + np.cumsum(started)
    return _recordings(samples, table, report, rows, ends, numbers)


def _drop_repeated(
    samples: Samples, table: Table, report: Report, rows: NDArray[Any], broken: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Drop a row whose time is that of the row before, and keep what interrupts them."""
    if not len(rows):
        return rows, broken
    same = np.diff(samples.time[rows], prepend=np.nan) == 0
    if samples.labels is not None:
        same[1:] &= np.array(
            [
                samples.labels[a] == samples.labels[b]
                for a, b in zip(rows[1:], rows[:-1], strict=True)
            ]
        )
    report.add("repeated_time", rows[same], table, "times that stand still; the rows are left out.")
    if same.sum() > max(1, _TOO_MANY * len(rows)):
        raise ConfigError(
            "columns.time",
            f"{table.source}: {int(same.sum())} of {len(rows)} times equal the one before; "
            "expected a clock that is fine enough to tell rows apart.",
        )
    return rows[~same], broken[~same]


def _lost(step: NDArray[Any], table: Table, report: Report, gap: float) -> NDArray[Any]:
    """Which rows come after a gap; none where the clock is so irregular that no gap can be told."""
    known = step[np.isfinite(step)]
    if not len(known):
        return np.zeros(len(step), dtype=bool)
    median = float(np.median(known))
    near = np.abs(known - median) <= 0.5 * median
    if near.mean() >= _REGULAR:
        spread = known[near].std() / median
        if spread > 0.02:
            report.counts["irregular_clocks"] += 1
            report.notes.append(
                f"{table.source}: the clock jitters by {100 * spread:.0f} % (standard deviation); "
                "each transition keeps its own time step."
            )
        return np.nan_to_num(step, nan=0.0) > gap * median
    report.counts["irregular_clocks"] += 1
    report.notes.append(
        f"{table.source}: the clock is irregular, with intervals from {known.min():.3g} to "
        f"{known.max():.3g} s (median {median:.3g} s), so lost rows cannot be told."
    )
    return np.zeros(len(step), dtype=bool)


def _recordings(
    samples: Samples,
    table: Table,
    report: Report,
    rows: NDArray[Any],
    ends: NDArray[Any],
    numbers: NDArray[Any],
) -> list[Recording]:
    starts = np.flatnonzero(ends)
    found = []
    for start, stop in pairwise([*starts, len(rows)]):
        part = rows[start:stop]
        if len(part) < 2:
            report.add("alone", part, table, "row between two cuts, with no row to go with it.")
            continue
        # The last command is never used, and the last known input is taken to stay.
        action, inputs = samples.action[part].copy(), samples.inputs[part].copy()
        for values in (action, inputs):
            if not np.isfinite(values[-1]).all():
                values[-1] = values[-2]
        state = samples.state[part].copy()
        for i in samples.wrapped:
            known = np.isfinite(state[:, i])
            state[known, i] = np.unwrap(state[known, i])
        report.counts["samples"] += len(part)
        found.append(
            Recording(
                torch.from_numpy(samples.time[part]),
                torch.from_numpy(state),
                torch.from_numpy(action),
                source=table.place(int(part[0])),
                episode=int(numbers[start]),
                inputs=torch.from_numpy(inputs),
            )
        )
    return found
