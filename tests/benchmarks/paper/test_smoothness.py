"""The table of return against smoothness: which controllers, and what is not run."""

from __future__ import annotations

import json
from dataclasses import replace

import smoothness
from phihp_torchrl import Agent, HybridDynamics, get_task, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.planners import CEMConfig


def make_agent():
    task = get_task("cartpole")
    plan = CEMConfig(num_candidates=4, top_k=2, num_kept_elites=1, num_policy_candidates=1)
    plan = replace(plan, planning_horizon=1, optim_steps=1)
    dynamics = HybridDynamics.pure_prior(task)
    return Agent(task, dynamics=dynamics, actor=Actor(task), planner_config=plan)


def test_prices_are_the_only_difference_between_the_plans():
    agent = make_agent()
    found = smoothness.controllers(agent)
    assert found["planner as shipped"] is agent
    assert found["actor"].planner is None
    for price in (0.3, 1.0):
        config = found[f"planner, change_cost {price:g}"].planner_config
        assert config == replace(agent.planner_config, change_cost=price)


def test_it_writes_what_was_played_and_names_what_was_not(tmp_path):
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


def test_what_calibration_chose_stands_beside_what_was_played(tmp_path):
    """Whoever acts: here the actor, with a mean of 3 and a standard error of 1."""
    assert smoothness.calibrated("cartpole", tmp_path / "out") == {}
    world = {"chosen": {"returns": [9.0, 9.0], "chatter": 0.5}}
    world["actor"] = {"returns": [2.0, 4.0], "chatter": 0.1}
    (tmp_path / "calibration").mkdir()
    found = {"acting": "actor", "world": world}
    (tmp_path / "calibration" / "cartpole.json").write_text(json.dumps(found))
    played = {"return_mean": 5.0, "standard_error": 0.5, "chatter": 0.9}
    result = {"task": "cartpole", "episodes": 2, "measured": {"actor": played}}
    smoothness.write(result | {"origin": smoothness.describe_origin(0)}, tmp_path / "out")
    text = (tmp_path / "out" / "README.md").read_text()
    assert "| cartpole | as calibrated, 2 episodes | 3.0 | 1.0 | 0.100 |" in text
    (tmp_path / "out" / "README.md").unlink()
    smoothness.main(["--tasks", "--results", str(tmp_path / "out")])
    assert (tmp_path / "out" / "README.md").read_text() == text
