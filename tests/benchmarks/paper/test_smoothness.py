"""The table of return against smoothness: which controllers, and what is not run."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import smoothness
from phihp_torchrl import Agent, HybridDynamics, get_task, load_config, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import read_run_config


def make_agent():
    task = get_task("cartpole")
    plan = CEMConfig(num_candidates=4, top_k=2, num_kept_elites=1, num_policy_candidates=1)
    plan = replace(plan, planning_horizon=1, optim_steps=1)
    dynamics = HybridDynamics.pure_prior(task)
    return Agent(task, dynamics=dynamics, actor=Actor(task), planner_config=plan)


def test_prices_are_the_only_difference_between_the_plans_of_the_preset():
    agent = make_agent()
    found = smoothness.controllers(agent)
    assert found["as shipped"] is agent
    assert found["actor"].planner is None
    preset = found["plans of the preset"].planner_config
    assert preset == read_run_config(load_config("cartpole")).planner
    for price in (0.3, 1.0):
        config = found[f"plans of the preset, change_cost {price:g}"].planner_config
        assert config == replace(preset, change_cost=price)


def test_it_writes_what_was_played_and_names_what_was_not(tmp_path, monkeypatch):
    small = SimpleNamespace(planner=make_agent().planner_config)
    monkeypatch.setattr(smoothness, "read_run_config", lambda _: small)
    save_agent(make_agent(), tmp_path / "agents" / "cartpole")
    words = ["--tasks", "cartpole", "--episodes", "2"]
    words += ["--agents", str(tmp_path / "agents"), "--results", str(tmp_path / "out")]
    smoothness.main(words)
    kept = json.loads((tmp_path / "out" / "cartpole.json").read_text())
    assert kept["seed"] == 1_000_000
    text = (tmp_path / "out" / "README.md").read_text()
    for name, found in kept["measured"].items():
        assert len(found["returns"]) == len(found["chatters"]) == 2
        mean = sum(found["returns"]) / 2
        assert f"| cartpole | {name} | {mean:.1f} |" in text
    assert "Not run: pendulum, pendulum-swingup, cartpole-swingup, acrobot" in text
    assert (tmp_path / "out" / "smoothness.png").stat().st_size > 1000
    (tmp_path / "out" / "README.md").unlink()
    smoothness.main(["--tasks", "--results", str(tmp_path / "out")])
    assert (tmp_path / "out" / "README.md").read_text() == text
