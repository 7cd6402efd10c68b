"""What interrupts a recording, what is kept, and what is counted."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import RecordedData, read_recordings
from tests.recordings.log_parts import OpenTank, Rig, Tank, samples, write_csv


def tank(path: Path, **columns: list[object]) -> RecordedData:
    count = len(next(iter(columns.values())))
    full = {
        "time": [float(k) for k in range(count)],
        "level": [0.1 * k for k in range(count)],
        "pump": [1.0] * count,
    }
    return read_recordings(Tank(), write_csv(path / "tank.csv", {**full, **columns}))


def times(data: RecordedData) -> list[list[float]]:
    return [recording.time.tolist() for recording in data.recordings]


def test_a_missing_time_and_a_missing_command_end_a_recording(tmp_path: Path) -> None:
    data = tank(tmp_path, time=[0.0, 1.0, "", 3.0, 4.0, 5.0, 6.0])
    assert times(data) == [[0.0, 1.0], [3.0, 4.0, 5.0, 6.0]]
    assert data.counts["missing_time"] == 1
    data = tank(tmp_path, pump=[1.0, 1.0, "nan", 2.0, 2.0])
    # The state of the row without a command is where the command before it has led to.
    assert times(data) == [[0.0, 1.0, 2.0], [3.0, 4.0]]
    assert data.recordings[0].action[:, 0].tolist() == [1.0, 1.0, 1.0]
    assert data.counts["missing_command"] == 1
    assert "tank.csv, line 4: 1 rows without a command" in " ".join(data.notes)


def test_a_missing_input_ends_a_recording_as_a_missing_command_does(tmp_path: Path) -> None:
    columns = {
        "time": range(7),
        "level": [0.1 * k for k in range(7)],
        "pump": [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, "nan"],
        "rain": [0.0, 1.0, "", 3.0, 4.0, 5.0, "inf"],
    }
    data = read_recordings(OpenTank(), write_csv(tmp_path / "tank.csv", columns))
    # The state of the row without an input is where those before it have led to.
    assert times(data) == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0, 6.0]]
    # The last one is taken to stay.
    assert [r.inputs[:, 0].tolist() for r in data.recordings] == [[0, 1, 1], [3, 4, 5, 5]]
    assert (data.counts["missing_input"], data.counts["missing_command"]) == (2, 1)
    assert "tank.csv, line 4: 2 rows without an input; cut there." in " ".join(data.notes)


def test_a_missing_state_is_kept_and_an_infinite_one_is_missing(tmp_path: Path) -> None:
    data = tank(tmp_path, level=[0.0, "NaN", 0.2, "inf", 0.4])
    level = data.recordings[0].state[:, 0]
    assert level.isnan().tolist() == [False, True, False, True, False]
    assert (data.counts["missing_state"], data.counts["infinite"]) == (2, 1)


def test_rows_that_are_lost_end_a_recording(tmp_path: Path) -> None:
    data = tank(tmp_path, time=[0.0, 1.0, 2.1, 4.0, 5.0, *range(6, 20)])
    assert times(data)[0] == [0.0, 1.0, 2.1]
    assert times(data)[1][:2] == [4.0, 5.0]
    assert data.counts["lost"] == 1


def test_an_irregular_clock_is_kept_as_it_is_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = [float(x) for x in np.cumsum([0.0, 1, 5, 1, 7, 0.2, 9, 2, 4, 1, 8])]
    with caplog.at_level(logging.WARNING):
        data = tank(tmp_path, time=stamps)
    assert times(data) == [stamps]
    assert "intervals from 0.2 to 9 s" in caplog.text


def test_a_time_that_stands_still_is_left_out_and_one_that_goes_back_begins_anew(
    tmp_path: Path,
) -> None:
    data = tank(tmp_path, time=[0.0, 1.0, 1.0, 2.0, *range(3, 12)])
    assert times(data) == [[float(k) for k in range(12)]]
    assert data.counts["repeated_time"] == 1
    data = tank(tmp_path, time=[*range(8), *range(4)])
    assert [r.episode for r in data.recordings] == [0, 1]
    assert times(data) == [[float(k) for k in range(8)], [0.0, 1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("stamps", "message"),
    [([0.0, 1.0] * 6, "times go back"), ([0.0, 0.0, 1.0, 1.0, 2.0, 2.0], "equal the one before")],
)
def test_a_column_that_is_no_clock_is_refused(
    tmp_path: Path, stamps: list[object], message: str
) -> None:
    with pytest.raises(ConfigError, match=f"columns.time: .*tank.csv: .* {message}"):
        tank(tmp_path, time=stamps)


@pytest.mark.parametrize("text", ["abc", "1.2.3", "0x1F", "1_000", "12 V"])
def test_a_text_that_is_no_number_names_file_line_and_column(tmp_path: Path, text: str) -> None:
    message = f"tank.csv, line 4, column 'level': expected a number, got {text!r}"
    with pytest.raises(ConfigError, match=re.escape(message)):
        tank(tmp_path, level=[0.0, 1.0, text, 3.0])


def test_a_line_that_is_cut_short_is_left_out(tmp_path: Path) -> None:
    log = write_csv(tmp_path / "tank.csv", {"level": [1.0] * 8, "pump": [1.0] * 8})
    lines = log.read_text().splitlines()
    lines[4] = "1."
    log.write_text("\n".join(lines))
    data = read_recordings(Tank(), log, time_step=0.5)
    assert times(data) == [[0.0, 0.5, 1.0], [2.0, 2.5, 3.0, 3.5]]
    assert data.counts["ragged"] == 1
    assert "tank.csv, line 5: 1 rows with too few" in " ".join(data.notes)


def test_a_column_tells_episodes_apart(tmp_path: Path) -> None:
    columns = {**samples(6), "episode": ["a", "a", "a", "b", "b", "b"], "time": [0, 1, 2] * 2}
    found = read_recordings(Rig(), write_csv(tmp_path / "log.csv", columns)).recordings
    assert [(r.episode, len(r)) for r in found] == [(0, 3), (1, 3)]


@given(
    st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=30),
    st.sampled_from([0.0, math.pi]),
    st.booleans(),
)
def test_an_angle_that_wraps_is_continued_over_the_jump(
    tmp_path_factory: pytest.TempPathFactory, steps: list[float], low: float, degrees: bool
) -> None:
    angle = 0.5 + np.cumsum(steps)
    wrapped = np.remainder(angle + low, 2 * np.pi) - low
    columns = {**samples(len(steps)), "angle": np.rad2deg(wrapped) if degrees else wrapped}
    log = write_csv(tmp_path_factory.mktemp("logs") / "log.csv", columns)
    unit = {"angle": {"column": "angle", "unit": "deg"}} if degrees else {}
    found = read_recordings(Rig(), log, unit).recordings[0].state[:, 1].numpy()
    assert np.allclose(np.diff(found), np.diff(angle), atol=1e-9)


def test_an_angle_that_counts_on_is_left_as_it_is(tmp_path: Path) -> None:
    angle = np.cumsum([0.0, 4.0, 4.0, 4.0, -5.0])  # faster than half a turn a row
    log = write_csv(tmp_path / "log.csv", {**samples(5), "angle": angle})
    assert read_recordings(Rig(), log).recordings[0].state[:, 1].tolist() == angle.tolist()


def test_degrees_without_a_unit_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = write_csv(tmp_path / "log.csv", {**samples(5), "angle": [0, 100, 179, -179, -100]})
    with caplog.at_level(logging.WARNING):
        read_recordings(Rig(), log)
    assert "the values of angle look like degrees" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        read_recordings(Rig(), log, {"angle": {"column": "angle", "unit": "deg"}})
    assert not caplog.text


def test_every_transition_is_a_pair_of_consecutive_rows_of_the_file(tmp_path: Path) -> None:
    columns: dict[str, object] = dict(samples(200))
    draw = np.random.default_rng(3)
    columns["level"] = np.arange(200.0)
    for name in ("time", "force"):
        values = np.array(columns[name])
        values[draw.random(200) < 0.1] = np.nan
        columns[name] = values
    log = write_csv(tmp_path / "log.csv", {**columns, "x": columns.pop("level")})  # type: ignore
    data = read_recordings(Rig(), log)
    found = {
        (int(a), int(b))
        for r in data.recordings
        for a, b in zip(r.state[:-1, 0], r.state[1:, 0], strict=True)
    }
    known, told = np.isfinite(columns["time"]), np.isfinite(columns["force"])  # type: ignore
    expected = {(k, k + 1) for k in range(199) if known[k] and known[k + 1] and told[k]}
    assert found == expected
    assert all(torch.isfinite(r.action).all() for r in data.recordings)
    assert data.transitions == len(expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time_step": 0.0}, "time_step: expected a positive number"),
        ({"time_step": 0.1, "columns": {"time": "time"}}, "time_step: expected none"),
        ({"gap": 1.0}, "gap: expected a number above 1"),
        ({"decimal": ";"}, "decimal: expected"),
    ],
)
def test_wrong_options_are_refused(
    tmp_path: Path, options: dict[str, object], message: str
) -> None:
    log = write_csv(tmp_path / "log.csv", samples())
    with pytest.raises(ConfigError, match=message):
        read_recordings(Rig(), log, **options)  # type: ignore[arg-type]
