"""One file of the user's that registers a task, a planner, a world, a phase and a method."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from phihp_torchrl import Agent, get_task, save_agent
from phihp_torchrl.agents import Actor

from .command_parts import FAST, PLUGIN, metrics_column
from .conftest import Command

WORDS = (
    "task=my-pendulum",
    "world=rig",
    "world.number=7",
    "method=rested",
    "rest.naps=3",
    "planner=patient",
    "planner.patience=2.5",
    "plugins=[my_plugin.py]",
)


@pytest.fixture
def plugin(place: Path, registries: None) -> None:
    (place / "my_plugin.py").write_text(PLUGIN)


@pytest.mark.usefixtures("plugin")
def test_one_run_with_all_of_them(
    phihp: Command, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fast = [word for word in FAST if not word.startswith("calibrate.")]  # it has no such phase
    phihp("train", *WORDS, "run_dir=run", *fast)
    assert "| my-pendulum in rig | 1 | 60 |" in capsys.readouterr().out
    phases = metrics_column(place / "run", "phase")
    assert list(dict.fromkeys(phases)) == ["model", "rest", "policy", "evaluate"]
    assert phases.count("rest") == 3
    kept = yaml.safe_load((place / "run" / "config.yaml").read_text())
    assert kept["rest"] == {"naps": 3}
    assert kept["world"] == {"kind": "rig", "number": 7}
    assert (kept["planner"]["kind"], kept["planner"]["patience"]) == ("patient", 2.5)
    assert kept["policy"]["decay"] == 0.25
    phihp("train", "resume=run")
    with pytest.raises(SystemExit, match=r"rest\.naps: 4, not 3"):
        phihp("train", "resume=run", "rest.naps=4")
    phihp("evaluate", "agent=run/agent", "plugins=[my_plugin.py]", "episodes=1", "video=false",
          "latency_actions=0")  # fmt: skip
    assert "my-pendulum in rig 7" in capsys.readouterr().out
    # The same world, and the same seeds: the same returns.
    during, after = (
        json.loads((place / "run" / name).read_text())
        for name in ("evaluation.json", "agent/evaluation.json")
    )
    assert during["planner"]["returns"] == after["planner"]["returns"]


@pytest.mark.usefixtures("registries")
def test_export_imports_the_task_of_a_plugin(phihp: Command, place: Path) -> None:
    task = replace(get_task("pendulum"), name="my-pendulum", max_steps=20)
    save_agent(Agent(task, actor=Actor(task, (4,))), place / "agent")
    words = ("export", "agent=agent", "format=c", "parts=[actor]", "states=2", "out=exported")
    with pytest.raises(SystemExit, match=r"got 'my-pendulum'.*plugins=\[my_task\.py\]"):
        phihp(*words)
    (place / "my_plugin.py").write_text(PLUGIN)
    phihp(*words, "plugins=[my_plugin.py]")
    assert (place / "exported" / "actor.c").is_file()
