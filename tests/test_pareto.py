"""The sweep of planning budgets: what it plays, what it chooses, what it writes."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation import EVALUATION_SEED
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.trainers import read_request

RECIPES = Path(__file__).parents[1] / "recipes"
TINY = PlannerConfig(
    planning_horizon=2, optim_steps=1, num_candidates=4, top_k=2, num_policy_candidates=2, alpha=0.7
)


@pytest.fixture
def module(monkeypatch):
    """The recipe as it is, reading and writing what is committed."""
    monkeypatch.syspath_prepend(str(RECIPES))
    spec = importlib.util.spec_from_file_location("pareto_recipe", RECIPES / "pareto.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recipe(module, tmp_path, monkeypatch):
    """The recipe on a small agent, writing elsewhere."""
    task = replace(get_task("pendulum"), max_steps=2)
    parts = {"actor": Actor(task, (4,)), "qvalue": TwinQ(task, (4,)), "planner_config": TINY}
    agent = Agent(task, dynamics=HybridDynamics.hybrid(task), **parts)
    monkeypatch.setattr(module, "load_agent", lambda path: agent)
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    return module


def rows(**returns):
    return {name: {"ms": ms, "returns": [r, r + 1.0, r + 2.0]} for name, (ms, r) in returns.items()}


def test_the_cheapest_that_loses_nothing(recipe, monkeypatch):
    monkeypatch.setattr(recipe, "BUDGETS", dict.fromkeys(["published", "cheap", "bad"]))
    monkeypatch.setattr(recipe, "PUBLISHED", "published")
    one = rows(published=(9.0, 0.0), cheap=(2.0, 0.0), bad=(1.0, 0.0))
    assert recipe.choose({"a": one}) == "bad"
    other = rows(published=(9.0, 0.0), cheap=(2.0, 1.0), bad=(1.0, -5.0))
    assert recipe.choose({"a": one, "b": other}) == "cheap"


def test_budgets(recipe):
    agent = recipe.load_agent("")
    published = recipe.planner_config("acrobot", recipe.PUBLISHED)
    assert (published.num_candidates, published.optim_steps) == (220, 3)
    assert not published.compare_with_actor
    assert (published.planning_horizon, published.alpha) == (4, 0.8)
    ours = recipe.planner_config("acrobot", "64 x 1")
    assert (ours.num_candidates, ours.optim_steps) == (64, 1)
    assert ours.compare_with_actor
    assert ours.planning_horizon == 5
    for name in recipe.BUDGETS:
        assert recipe.build(agent, name).settings.num_candidates <= 220


def test_the_choice_never_sees_an_evaluation_seed(recipe, monkeypatch, capsys):
    seeds, play = [], recipe.evaluate

    def watched(policy, task, *, episodes, seed):
        seeds.append(seed)
        return play(policy, task, episodes=2, seed=seed)

    monkeypatch.setattr(recipe, "evaluate", watched)
    build = recipe.build
    monkeypatch.setattr(recipe, "build", lambda agent, name, compile=False: build(agent, name))
    monkeypatch.setattr(sys, "argv", ["pareto.py", "--tasks", "pendulum", "--calls", "10"])
    recipe.main()
    assert set(seeds) == {recipe.SWEEP_SEED}
    assert recipe.SWEEP_SEED < EVALUATION_SEED
    assert len(seeds) == len(recipe.BUDGETS)
    assert (recipe.RESULTS / "pareto.png").is_file()
    # The report plays the two that it compares once each.
    monkeypatch.setattr(
        sys, "argv", ["pareto.py", "--report", "--tasks", "pendulum", "--calls", "10"]
    )
    seeds.clear()
    recipe.main()
    assert seeds == [EVALUATION_SEED] * 2
    results = json.loads((recipe.RESULTS / "pareto.json").read_text())
    assert results["report"]["rows"]["pendulum"]["chosen"] in recipe.BUDGETS
    assert list(results["origins"]) == ["pendulum"]
    assert "On evaluation seeds" in (recipe.RESULTS / "README.md").read_text()
    assert torch.get_num_threads() == 1


def test_tasks_swept_before_stay(recipe, monkeypatch):
    """Unless they were swept with other budgets, with which these cannot be compared."""

    def swept(budgets, task):
        monkeypatch.setattr(recipe, "BUDGETS", dict.fromkeys(budgets))
        found = rows(**{name: (9.0, 0.0) for name in budgets})
        monkeypatch.setattr(recipe, "sweep", lambda *_: found)
        monkeypatch.setattr(sys, "argv", ["pareto.py", "--tasks", task])
        recipe.main()
        return list(json.loads((recipe.RESULTS / "pareto.json").read_text())["tasks"])

    monkeypatch.setattr(recipe, "PUBLISHED", "published")
    assert swept(["published", "cheap"], "acrobot") == ["acrobot"]
    assert swept(["published", "cheap"], "pendulum") == ["acrobot", "pendulum"]
    assert swept(["published", "cheap", "new"], "pendulum") == ["pendulum"]


@pytest.mark.parametrize("task", ["acrobot", "pendulum-swingup"])
def test_the_fast_budget_is_what_the_sweep_chose(module, task):
    swept = json.loads((RECIPES.parent / module.RESULTS / "pareto.json").read_text())
    chosen = module.choose(swept["tasks"])
    lines = [f"task={task}", "budget=fast"]
    with initialize_config_dir(str(RECIPES / "config"), version_base="1.3"):
        fast = read_request(compose("phihp", lines), lines).config.planner
    assert fast == module.planner_config(task, chosen)
