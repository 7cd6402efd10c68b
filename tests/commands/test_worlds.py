"""Runs in worlds that are not simulated: a gymnasium id, and any TorchRL environment."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from .command_parts import FAST, RIG, metrics_column
from .conftest import Command

PLAY = ("episodes=1", "latency_actions=0", "video=false")


@pytest.fixture
def rig(place: Path) -> Iterator[None]:
    """A module in the working directory."""
    (place / "my_rig.py").write_text(RIG)
    yield
    sys.modules.pop("my_rig", None)


def returns(path: Path) -> dict[str, list[float]]:
    return {name: part["returns"] for name, part in json.loads(path.read_text()).items()
            if name != "baselines"}  # fmt: skip


def test_a_gymnasium_id_from_training_to_playing(
    phihp: Command, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    phihp("train", "world=gymnasium", "world.id=Pendulum-v1", "run_dir=run", *FAST)
    assert "| pendulum in gymnasium | 1 | 60 |" in capsys.readouterr().out
    run = place / "run"
    assert list(dict.fromkeys(metrics_column(run, "phase"))) == ["model", "policy", "evaluate"]
    kept = yaml.safe_load((run / "config.yaml").read_text())
    assert kept["task"] == "pendulum"  # nobody named it
    expected = {"kind": "gymnasium", "id": "Pendulum-v1", "options": {}, "copies": None}
    assert kept["world"] == expected
    phihp("train", "resume=run")  # there is nothing left to do
    phihp("evaluate", "agent=run/agent", *PLAY)
    assert "pendulum in gymnasium Pendulum-v1" in capsys.readouterr().out
    # The world that it was trained in, by the same seeds: the same returns.
    assert returns(run / "agent" / "evaluation.json") == returns(run / "evaluation.json")
    simulated = ("world=simulated", "out_dir=simulated", "baselines=none")
    phihp("evaluate", "agent=run/agent", *simulated, *PLAY)
    assert "pendulum in simulated" in capsys.readouterr().out
    elsewhere = returns(place / "simulated" / "evaluation.json")
    assert elsewhere != returns(run / "evaluation.json")  # friction, and other starts


@pytest.mark.usefixtures("rig")
def test_a_module_of_the_working_directory(
    phihp: Command, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("world=torchrl", "world.make=my_rig:make_env", "task=pendulum")
    phihp("train", *words, "run_dir=run", *FAST)
    assert "| pendulum in torchrl | 1 | 60 |" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"say trust=true"):
        phihp("evaluate", "agent=run/agent", "baselines=none", *PLAY)
    phihp("evaluate", "agent=run/agent", "baselines=none", "trust=true", *PLAY)
    assert "pendulum in torchrl my_rig:make_env" in capsys.readouterr().out
    assert returns(place / "run/agent/evaluation.json") == returns(place / "run/evaluation.json")
    # Its keyword arguments are options; that one is an environment of another task.
    with pytest.raises(SystemExit, match=r"^error: world: expected 'observation' of shape \[3\]"):
        phihp("train", *words, "+world.options.task=acrobot", "run_dir=other", *FAST)
    assert not list((place / "other").rglob("*.csv"))


GYM = ("world=gymnasium", "world.id=Pendulum-v1")
TORCHRL = ("world=torchrl", "world.make=my_rig:make_env")


@pytest.mark.usefixtures("rig")
@pytest.mark.parametrize(
    ("world", "words", "message"),
    [
        (GYM, ("method=td3",), r"^error: method: .*'td3'"),
        (TORCHRL, ("method=ph-td-mpc-star",), r"^error: method: .*'ph-td-mpc-star'"),
        (GYM, ("method=cem-oracle",), r"^error: model\.kind: .*'oracle'"),
        (TORCHRL, ("model.kind=oracle",), r"^error: model\.kind: .*'oracle'"),
    ],
)
def test_what_needs_a_truth_is_refused_before_any_step(
    phihp: Command, place: Path, world: tuple[str, ...], words: tuple[str, ...], message: str
) -> None:
    with pytest.raises(SystemExit, match=message):
        phihp("train", "task=pendulum", *world, *words, "run_dir=run")
    assert not (place / "run").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("world=gymnasium",), r"world\.id: "),
        (("world=gymnasium", "world.id=Nothing-v0"), r"world\.id: 'Nothing-v0'"),
        (("world=gymnasium", "world.id=CartPole-v1", "task=cartpole"), r"world\.id: .*continuous"),
        (("world=gymnasium", "world.id=Pendulum-v1", "task=acrobot"), "world: .*theta1"),
        (("world=torchrl", "world.make=nowhere:make"), r"world\.make: nowhere:make .*nowhere"),
        (("world=torchrl", "world.make=make"), r"world\.make: expected module:function"),
        (("world=rig",), "world: .*'rig'"),
        (("world=given",), r"world\.kind: .*pass that world again"),
    ],
)
def test_a_world_that_is_not_there_is_one_sentence(
    phihp: Command, place: Path, words: tuple[str, ...], message: str
) -> None:
    with pytest.raises(SystemExit, match=f"^error: {message}"):
        phihp("train", *words, "run_dir=run", "progress=false")
    assert not list(place.rglob("*.csv"))
