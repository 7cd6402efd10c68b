"""Learning from logs alone, from the command line and from Python."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import yaml

from phihp_torchrl import get_task, learn, load_agent, load_config
from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import Recording

from .command_parts import FAST, metrics_column
from .conftest import Command

RIG = """
from dataclasses import replace
from phihp_torchrl import get_task, register_task

register_task(replace(get_task("pendulum"), name="rig", max_steps=20), replace=True)
"""

SETTINGS = """
# @package _global_
task: rig
columns:
  time: {column: ms, unit: ms}
  theta: {column: angle, unit: deg}
presets: {}
"""


@pytest.fixture
def rig(place: Path) -> Iterator[None]:
    """A plugin with a task, its settings with columns, and two logs."""
    (place / "my_rig.py").write_text(RIG)
    (place / "config" / "task").mkdir(parents=True)
    (place / "config" / "task" / "rig.yaml").write_text(SETTINGS.lstrip())
    (place / "logs").mkdir()
    for k in range(2):
        lines = ["ms,angle,torque"]
        for i in range(40):
            angle = 30.0 * torch.tensor(0.2 * i + k).sin().item()
            lines.append(f"{50 * i},{angle:.4f},{(-1) ** (i // 5)}")
        (place / "logs" / f"{k}.csv").write_text("\n".join(lines) + "\n")
    yield
    sys.modules.pop("my_rig", None)


WORDS = ("--config-dir", "config", "task=rig", "plugins=[my_rig.py]", "world=recorded")


@pytest.mark.usefixtures("rig")
def test_logs_whose_columns_the_task_names(
    phihp: Command, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    phihp("train", *WORDS, "world.files=logs/*.csv", "run_dir=run", *FAST)
    assert "Everything is in run" in capsys.readouterr().out
    assert metrics_column(place / "run", "real_steps")[-1] == "78"
    world = yaml.safe_load((place / "run" / "config.yaml").read_text())["world"]
    assert (world["kind"], world["files"]) == ("recorded", "logs/*.csv")
    assert world["columns"]["theta"] == {"column": "angle", "unit": "deg"}
    agent = load_agent(place / "run" / "agent", task=get_task("rig"))
    assert agent.actor is not None
    phihp("train", "resume=run")  # the configuration knows all that it needs


@pytest.mark.usefixtures("rig")
def test_nobody_plays_in_logs_and_they_are_not_read_for_that(
    phihp: Command,
    place: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    phihp("train", *WORDS, "world.files=logs/*.csv", "run_dir=run", *FAST)
    out = capsys.readouterr().out
    assert "phihp evaluate" not in out
    assert "export agent=run/agent" in out

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the files were read")

    monkeypatch.setattr("phihp_torchrl.worlds.recorded.read_recordings", refuse)
    words = ("evaluate", "agent=run/agent", "plugins=[my_rig.py]", "episodes=1", "video=false")
    with pytest.raises(SystemExit, match=r"^error: world: .*in which the agent was trained"):
        phihp(*words)
    with pytest.raises(SystemExit, match=r"^error: world: expected one to act in, got recordings"):
        phihp(*words, "world=recorded", "world.files=logs/*.csv")
    phihp(*words, "world=simulated", "baselines=none", "latency_actions=0")


@pytest.mark.usefixtures("rig")
def test_the_phases_that_are_left_are_done_by_the_command_that_is_printed(
    phihp: Command, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ("world.files=logs/*.csv", "actuator.delay_steps=1", "action_rate_cost=0.1")
    phihp("train", *WORDS, *settings, "run_dir=run", "phases=[model]", *FAST)
    (line,) = [ln for ln in capsys.readouterr().out.splitlines() if " train " in ln]
    pasted = shlex.split(line.partition(" train ")[2])
    phihp("train", *pasted, "run_dir=after")
    first, after = (
        yaml.safe_load((place / name / "config.yaml").read_text()) for name in ("run", "after")
    )
    own = ("phases", "from")
    assert {k: v for k, v in after.items() if k not in own} == {
        k: v for k, v in first.items() if k not in own
    }
    assert (place / "after" / "agent").is_dir()


@pytest.mark.usefixtures("rig")
def test_a_wrong_column_is_refused_before_the_run(phihp: Command, place: Path) -> None:
    wrong = "world.columns={theta: angel}"
    with pytest.raises(SystemExit, match=r"^error: world.columns.theta: .* did you mean 'angle'"):
        phihp("train", *WORDS, "world.files=logs/0.csv", wrong, "run_dir=run", *FAST)
    with pytest.raises(SystemExit, match=r"^error: world.files: no file matches"):
        phihp("train", *WORDS, "world.files=nothing/*.csv", "run_dir=run", *FAST)
    assert not (place / "run").exists()


@pytest.mark.usefixtures("rig")
def test_columns_of_a_task_are_unused_in_other_worlds(place: Path) -> None:
    plain = load_config("rig", config_dir=place / "config")
    assert "columns" not in plain
    assert "columns" not in plain["world"]
    words = ["world=recorded", "world.files=a.csv", "world.columns={theta: b, torque: c}"]
    recorded = load_config("rig", config_dir=place / "config", overrides=words)
    assert recorded["world"]["columns"] == {
        "time": {"column": "ms", "unit": "ms"},
        "theta": "b",
        "torque": "c",
    }


@pytest.mark.usefixtures("rig")
def test_learn_takes_recordings_and_settings(phihp: Command, place: Path) -> None:
    words = [word for word in FAST if word != "evaluate.video=false"]
    time = 0.05 * torch.arange(60, dtype=torch.float64)
    log = Recording(time, torch.stack([time.sin(), time.cos()], -1), torch.zeros(60, 1))
    agent, path = learn("pendulum", [log], overrides=words, run_dir="given")
    assert agent.planner is not None
    assert yaml.safe_load((path / "config.yaml").read_text())["world"] == {"kind": "given"}
    world = {"kind": "recorded", "files": "logs/*.csv"}
    _, path = learn(
        "rig",
        world,
        overrides=[*words, "plugins=[my_rig.py]"],
        run_dir="files",
        config_dir="config",
    )
    assert metrics_column(path, "real_steps")[-1] == "78"
    with pytest.raises(ConfigError, match="unknown key"):
        learn("pendulum", {**world, "colums": {}}, overrides=words, run_dir="wrong")
