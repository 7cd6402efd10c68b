"""A world of recordings: how it is made, what it has, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from phihp_torchrl import get_task, make_world
from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import RecordedData, Recording
from phihp_torchrl.worlds import RecordedConfig, RecordedWorld, SimulatedWorld

PENDULUM = get_task("pendulum")


def swing(count: int = 60, velocity: bool = False) -> Recording:
    time = PENDULUM.time_step * torch.arange(count, dtype=torch.float64)
    state = torch.stack([time.sin(), time.cos()], -1)
    if not velocity:
        state[:, 1] = torch.nan
    return Recording(time, state, torch.zeros(count, 1))


def write(path: Path, count: int = 60) -> Path:
    log = swing(count)
    rows = torch.cat([log.time[:, None], log.state[:, :1].rad2deg(), log.action], -1).numpy()
    np.savetxt(path, rows, delimiter=",", header="t,angle,torque", comments="")
    return path


COLUMNS = {"time": "t", "theta": {"column": "angle", "unit": "deg"}}


@pytest.mark.parametrize(
    "given",
    [swing(), [swing()], (swing(),), RecordedData([swing()])],
    ids=["one", "many", "t", "d"],
)
def test_recordings_are_a_world_without_an_environment(given: object) -> None:
    world = make_world("pendulum", given)
    assert isinstance(world, RecordedWorld)
    assert not world.has_env
    assert world.truth is None
    assert world.model() is None
    with pytest.raises(ConfigError, match="recordings alone, nobody can act in it"):
        world.make_env()
    assert SimulatedWorld(PENDULUM).has_env
    assert SimulatedWorld(PENDULUM).recordings is None


def test_velocities_are_estimated_where_nobody_measured_them() -> None:
    world = RecordedWorld(PENDULUM, [swing()])
    truth = swing(velocity=True).state[:, 1]
    assert torch.allclose(world.recordings[0].state[:, 1], truth, atol=0.02)
    assert world.measured[0].state[:, 1].isnan().all()
    known = RecordedWorld(PENDULUM, [swing(velocity=True)])
    assert torch.equal(known.recordings[0].state, swing(velocity=True).state)


@pytest.mark.parametrize("listed", [False, True])
def test_settings_make_it_from_files(tmp_path: Path, listed: bool) -> None:
    write(tmp_path / "a.csv")
    write(tmp_path / "b.csv", 30)
    files = (
        [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")] if listed else str(tmp_path / "*.csv")
    )
    world = make_world("pendulum", {"kind": "recorded", "files": files, "columns": COLUMNS})
    assert [len(log) for log in world.recordings or ()] == [60, 30]
    assert str(world).startswith("recorded ")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "world.files: missing"),
        ({"files": []}, "world.files: expected a file"),
        ({"files": "none.csv"}, "world.files: no file matches 'none.csv'"),
        ({"files": "a.csv", "gap": 0.5}, "world.gap: expected a number above 1"),
        ({"files": "a.csv", "time_step": -1.0}, "world.time_step: expected a positive number"),
        ({"files": "a.csv", "decimal": ";"}, "world.decimal: expected"),
        ({"files": "a.csv", "columns": {"angle": "a"}}, "world.columns.angle: expected one of"),
    ],
)
def test_wrong_settings_are_refused_by_name(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_world("pendulum", {"kind": "recorded", **settings})


def test_recordings_of_another_system_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected states .* got 2 and 1 columns"):
        make_world("cartpole", [swing()])
    with pytest.raises(ConfigError, match="expected at least one recording"):
        RecordedWorld(PENDULUM, [])
    with pytest.raises(ConfigError, match="or recordings"):
        make_world("pendulum", [])
    assert RecordedConfig("a.csv").smooth
