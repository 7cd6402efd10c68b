"""Names, units, signs and offsets of columns."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import Column, read_recordings
from phihp_torchrl.recordings.units import UNITS
from tests.recordings.log_parts import OpenTank, Rig, Tank, samples, write_csv

NUMBERS = st.floats(-1e6, 1e6)


@given(NUMBERS, st.sampled_from(sorted(UNITS)), st.sampled_from([-2.0, -1.0, 0.5]), NUMBERS)
def test_a_value_is_scale_times_the_number_in_si_units_plus_the_offset(
    number: float, unit: str, scale: float, offset: float
) -> None:
    turn = 2048.0 if unit == "counts" else None
    column = Column("c", unit=unit, scale=scale, offset=offset, per_turn=turn)
    value = column.convert(np.array([number]))
    assert value == pytest.approx(scale * number * UNITS[unit][0] / (turn or 1.0) + offset)


@pytest.mark.parametrize(
    ("number", "unit", "expected"),
    [
        (180.0, "deg", math.pi),
        (1.0, "turn", 2 * math.pi),
        (60.0, "rpm", 2 * math.pi),
        (250.0, "mm", 0.25),
        (12.5, "percent", 0.125),
        (1500.0, "ms", 1.5),
        (36.0, "km/h", 10.0),
        (60.0, "l/min", 1e-3),
    ],
)
def test_units_are_what_their_names_say(number: float, unit: str, expected: float) -> None:
    assert Column("c", unit=unit).convert(np.array([number]))[0] == pytest.approx(expected)


@given(st.floats(-3.1, 3.1))
def test_an_angle_comes_from_its_cosine_and_sine(angle: float) -> None:
    from phihp_torchrl.recordings.tables import Table

    table = Table("log", {"c": np.array([math.cos(angle)]), "s": np.array([math.sin(angle)])})
    assert Column(cos="c", sin="s", scale=-1.0).read(table)[0] == pytest.approx(-angle)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"column": "a", "unit": "degre"}, "unit: unknown unit 'degre'; did you mean 'deg'?"),
        ({"column": "a", "scale": 0.0}, "scale: expected a finite number other than 0"),
        ({"column": "a", "offset": math.nan}, "offset: expected a finite number"),
        ({"column": "a", "unit": "counts"}, "per_turn: expected the counts in a turn"),
        ({"column": "a", "per_turn": 4.0}, "per_turn: expected the counts in a turn"),
        ({"column": "a", "unit": "counts", "per_turn": 0.0}, "per_turn: expected a positive"),
        ({}, "column: expected the name of a column"),
        ({"cos": "a"}, "column: expected the name of a column"),
        ({"column": "a", "cos": "a", "sin": "b"}, "column: expected the name of a column"),
        ({"cos": "a", "sin": "b", "unit": "deg"}, "unit: expected none"),
        ({"columm": "a"}, "columm: unknown key; did you mean 'column'?"),
    ],
)
def test_a_wrong_field_is_refused_by_its_name(
    tmp_path: Path, fields: dict[str, object], message: str
) -> None:
    log = write_csv(tmp_path / "log.csv", samples())
    with pytest.raises(ConfigError, match=re.escape(f"columns.angle.{message}")):
        read_recordings(Rig(), log, {"angle": fields})


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"angel": "a"}, "columns.angel: expected one of"),
        ({"angel": "a"}, "did you mean 'angle'?"),
        ({"angle": 3}, "columns.angle: expected the name of a column or its fields, got 3"),
        ({"angle": {"column": "angle", "unit": "mm"}}, "columns.angle.unit: expected a unit of an"),
        ({"time": {"column": "time", "unit": "deg"}}, "columns.time.unit: expected a unit of time"),
        ({"x": {"cos": "x", "sin": "x"}}, "columns.x.cos: expected an angle"),
        ({"x": "X"}, "columns.x: "),
        ({"x": "angl"}, "has no column 'angl'; did you mean 'angle'? Its columns are ['angle', "),
        ({"x_dot": "speed"}, "columns.x_dot: "),
        ({"episode": "trial"}, "columns.episode: "),
    ],
)
def test_a_wrong_name_is_refused(tmp_path: Path, columns: dict[str, object], message: str) -> None:
    log = write_csv(tmp_path / "log.csv", samples())
    with pytest.raises(ConfigError, match=re.escape(message)):
        read_recordings(Rig(), log, columns)  # type: ignore[arg-type]


def test_a_state_an_action_and_a_clock_must_be_there_and_a_velocity_need_not(
    tmp_path: Path,
) -> None:
    for name in ("x", "force", "time"):
        columns = {k: v for k, v in samples().items() if k != name}
        log = write_csv(tmp_path / "log.csv", columns)
        with pytest.raises(ConfigError, match=f"columns.{name}: .* has no column '{name}'"):
            read_recordings(Rig(), log)
    columns = {k: v for k, v in samples().items() if k != "x_dot"}
    data = read_recordings(Rig(), write_csv(tmp_path / "log.csv", columns))
    assert data.recordings[0].measured.tolist() == [True, True, False, True]


def test_an_input_has_a_column_as_a_command_has(tmp_path: Path) -> None:
    columns = {"time": [0.0, 1.0], "level": [0.1, 0.2], "pump": [1.0, 1.0], "mm": [4.0, 6.0]}
    log = write_csv(tmp_path / "tank.csv", columns)
    rain = {"rain": {"column": "mm", "unit": "mm"}}
    found = read_recordings(OpenTank(), log, rain).recordings[0].inputs
    assert found.tolist() == [[0.004], [0.006]]
    with pytest.raises(ConfigError, match=r"columns.rain: .*tank.csv has no column 'rain'"):
        read_recordings(OpenTank(), log)
    with pytest.raises(ConfigError, match=r"columns.rain: expected one of"):
        read_recordings(Tank(), log, rain)
    assert read_recordings(Tank(), log).recordings[0].inputs.shape == (2, 0)


def test_a_file_without_rows_is_told(tmp_path: Path) -> None:
    log = tmp_path / "tank.csv"
    log.write_text("time,level,pump,rain\n")
    for system in (OpenTank(), Tank()):
        with pytest.raises(ConfigError, match="no two consecutive rows"):
            read_recordings(system, log)
