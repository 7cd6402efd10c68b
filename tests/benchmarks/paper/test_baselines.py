"""Baselines beside the agents of the six tasks: which play, in how many episodes, and how often."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from phihp_torchrl import Agent, HybridDynamics, get_task, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.planners import CEMConfig

# By its path, for tests of the package's own folder ``baselines`` have its name.
PATH = Path(__file__).parents[3] / "benchmarks" / "paper" / "baselines.py"
SPEC = importlib.util.spec_from_file_location("paper_baselines", PATH)
baselines = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(baselines)


def keep_agent(place, name: str, *, seed: int = 0) -> None:
    """An agent without a training, with weights of its own."""
    torch.manual_seed(seed)
    task = get_task(name)
    config = CEMConfig(planning_horizon=2, num_candidates=8, top_k=2, num_policy_candidates=1)
    agent = Agent(task, dynamics=HybridDynamics.hybrid(task), actor=Actor(task),
                  planner_config=config)  # fmt: skip
    save_agent(agent, place / name)


@pytest.fixture
def played(monkeypatch):
    """What was played, in place of playing it."""
    calls = []

    def measure(agent, name, episodes):
        calls.append((agent.task.name, name, episodes))
        return {"episodes": float(episodes), "returns": [1.0] * episodes}

    monkeypatch.setattr(baselines, "measure", measure)
    return calls


def test_all_that_apply_play_and_slow_ones_less_often(tmp_path, played, capsys) -> None:
    for name in ("pendulum", "acrobot"):
        keep_agent(tmp_path, name)
    out = tmp_path / "out"
    words = ["--agents", f"{tmp_path}", "--tasks", "pendulum", "acrobot", "--episodes", "4",
             "--slow-episodes", "2", "--out", f"{out}"]  # fmt: skip
    baselines.main(words)
    assert [each[1:] for each in played if each[0] == "pendulum"] == [
        ("planner", 4), ("actor", 4), ("lqr", 4), ("pid", 4), ("energy", 4), ("mppi", 2),
        ("ilqr", 2),
    ]  # fmt: skip
    assert {each[1] for each in played if each[0] == "acrobot"} == {
        "planner", "actor", "energy", "mppi",
    }  # fmt: skip
    said = capsys.readouterr().out
    assert "acrobot: baselines: 'ilqr' does not apply: reward: expected one that changes" in said
    page = (out / "README.md").read_text()
    assert "In 4 episodes. mppi was played in 2 episodes. ilqr was played in 2 episodes." in page


def test_what_is_there_of_the_same_weights_is_not_played_again(tmp_path, played) -> None:
    keep_agent(tmp_path, "pendulum")
    words = ["--agents", f"{tmp_path}", "--tasks", "pendulum", "--out", f"{tmp_path}"]
    old = {"acrobot": {"results": {"actor": {"episodes": 1.0, "returns": [2.0]}}, "origin": "old"}}
    (tmp_path / "baselines.json").write_text(json.dumps(old))
    baselines.main([*words, "--baselines", "lqr"])
    assert [name for _, name, _ in played] == ["planner", "actor", "lqr"]
    baselines.main([*words, "--baselines", "lqr", "pid"])
    assert [name for _, name, _ in played[3:]] == ["pid"]
    assert "Made at old." in (tmp_path / "README.md").read_text()
    keep_agent(tmp_path, "pendulum", seed=1)
    baselines.main([*words, "--baselines", "pid"])
    assert [name for _, name, _ in played[4:]] == ["planner", "actor", "pid"]


def test_a_planner_an_actor_and_a_baseline_are_measured_alike(monkeypatch) -> None:
    task = replace(get_task("pendulum"), max_steps=3)
    agent = Agent(task, dynamics=HybridDynamics.pure_prior(task), actor=Actor(task))
    monkeypatch.setattr(baselines, "_CALLS", 2)
    found = [baselines.measure(agent, name, 2) for name in ("actor", "lqr", "mppi")]
    for result in found:
        assert len(result["returns"]) == 2
        assert result["latency_ms_mean"] > 0
