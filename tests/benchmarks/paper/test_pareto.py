"""The sweep of planning budgets: what it plays, what it chooses, what it writes."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import pytest
import torch
from grid_cells import ROOT

import pareto
from phihp_torchrl import HybridDynamics, get_task, load_config
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation import EVALUATION_SEED
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import read_run_config

TINY = CEMConfig(
    planning_horizon=2, optim_steps=1, num_candidates=4, top_k=2, num_policy_candidates=2, alpha=0.7
)


@pytest.fixture
def script(tmp_path, monkeypatch):
    """The script on a small agent, writing elsewhere."""
    task = replace(get_task("pendulum"), max_steps=2)
    parts = {"actor": Actor(task, (4,)), "qvalue": TwinQ(task, (4,)), "planner_config": TINY}
    agent = Agent(task, dynamics=HybridDynamics.hybrid(task), **parts)
    monkeypatch.setattr(pareto, "load_agent", lambda path, **_: agent)
    monkeypatch.setattr(pareto, "RESULTS", tmp_path)
    return pareto


def rows(**returns):
    return {name: {"ms": ms, "returns": [r, r + 1.0, r + 2.0]} for name, (ms, r) in returns.items()}


def test_the_cheapest_that_loses_nothing(script, monkeypatch):
    monkeypatch.setattr(script, "BUDGETS", dict.fromkeys(["published", "cheap", "bad"]))
    monkeypatch.setattr(script, "PUBLISHED", "published")
    one = rows(published=(9.0, 0.0), cheap=(2.0, 0.0), bad=(1.0, 0.0))
    assert script.choose({"a": one}) == "bad"
    other = rows(published=(9.0, 0.0), cheap=(2.0, 1.0), bad=(1.0, -5.0))
    assert script.choose({"a": one, "b": other}) == "cheap"


def test_budgets(script):
    agent = script.load_agent("")
    published = script.planner_config("acrobot", script.PUBLISHED)
    assert (published.num_candidates, published.optim_steps) == (220, 3)
    assert not published.compare_with_actor
    assert (published.planning_horizon, published.alpha) == (4, 0.8)
    ours = script.planner_config("acrobot", "64 x 1")
    assert (ours.num_candidates, ours.optim_steps) == (64, 1)
    assert ours.compare_with_actor
    assert ours.planning_horizon == 5
    for name in script.BUDGETS:
        assert script.build(agent, name).settings.num_candidates <= 220


def test_the_choice_never_sees_an_evaluation_seed(script, monkeypatch, capsys):
    seeds, play = [], script.evaluate

    def watched(policy, task, *, episodes, seed):
        seeds.append(seed)
        return play(policy, task, episodes=2, seed=seed)

    monkeypatch.setattr(script, "evaluate", watched)
    build = script.build
    monkeypatch.setattr(script, "build", lambda agent, name, compile=False: build(agent, name))
    monkeypatch.setattr(sys, "argv", ["pareto.py", "--tasks", "pendulum", "--calls", "10"])
    script.main()
    assert set(seeds) == {script.SWEEP_SEED}
    assert script.SWEEP_SEED < EVALUATION_SEED
    assert len(seeds) == len(script.BUDGETS)
    assert (script.RESULTS / "pareto.png").is_file()
    # The report plays the two that it compares once each.
    monkeypatch.setattr(
        sys, "argv", ["pareto.py", "--report", "--tasks", "pendulum", "--calls", "10"]
    )
    seeds.clear()
    script.main()
    assert seeds == [EVALUATION_SEED] * 2
    results = json.loads((script.RESULTS / "pareto.json").read_text())
    assert results["report"]["rows"]["pendulum"]["chosen"] in script.BUDGETS
    assert list(results["origins"]) == ["pendulum"]
    assert "On evaluation seeds" in (script.RESULTS / "README.md").read_text()
    assert torch.get_num_threads() == 1


def test_tasks_swept_before_stay(script, monkeypatch):
    """Unless they were swept with other budgets, with which these cannot be compared."""

    def swept(budgets, task):
        monkeypatch.setattr(script, "BUDGETS", dict.fromkeys(budgets))
        found = rows(**{name: (9.0, 0.0) for name in budgets})
        monkeypatch.setattr(script, "sweep", lambda *_: found)
        monkeypatch.setattr(sys, "argv", ["pareto.py", "--tasks", task])
        script.main()
        return list(json.loads((script.RESULTS / "pareto.json").read_text())["tasks"])

    monkeypatch.setattr(script, "PUBLISHED", "published")
    assert swept(["published", "cheap"], "acrobot") == ["acrobot"]
    assert swept(["published", "cheap"], "pendulum") == ["acrobot", "pendulum"]
    assert swept(["published", "cheap", "new"], "pendulum") == ["pendulum"]


@pytest.mark.parametrize("task", ["acrobot", "pendulum-swingup"])
def test_the_fast_budget_is_what_the_sweep_chose(task):
    swept = json.loads((ROOT / pareto.RESULTS / "pareto.json").read_text())
    chosen = pareto.choose(swept["tasks"])
    fast = read_run_config(load_config(task, overrides=["budget=fast"])).planner
    assert fast == pareto.planner_config(task, chosen)
