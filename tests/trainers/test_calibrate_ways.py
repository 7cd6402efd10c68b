"""The ways to plan that calibration compares."""

from __future__ import annotations

from dataclasses import replace

from phihp_torchrl import load_config
from phihp_torchrl.planners import FAST_LIMITS, CEMConfig, MPPIConfig
from phihp_torchrl.trainers import (
    read_run_config,
)
from phihp_torchrl.trainers.calibrate_ways import calmer, faster, leaving


def test_each_way_fits_the_settings_and_changes_them():
    ways = calmer(CEMConfig(), 0.5)
    assert list(ways) == ["still", "calm", "mild", "loose"]
    for changes in ways.values():
        assert replace(CEMConfig(), **changes) != CEMConfig()
    alone = leaving(CEMConfig(), 1.234, 0.5)
    assert alone["leaving"] == {"actor_margin": 6.2, "margin_at_rest": True}
    assert replace(CEMConfig(), **alone["priced"]).keep_incumbent
    known = replace(CEMConfig(), warm_start=True)
    assert "warm_start" not in calmer(known, 0.5)["calm"]
    far = calmer(CEMConfig(50, optim_steps=1), 0.5)
    assert (far["still"]["planning_horizon"], far["still"]["optim_steps"]) == (10, 2)
    assert "planning_horizon" not in far["calm"]


def test_a_planner_is_asked_only_for_what_it_has():
    ways = calmer(MPPIConfig(), 1.0)
    assert {key for way in ways.values() for key in way} == {
        "change_cost",
        "noise_beta",
        "init_std",
    }
    assert leaving(MPPIConfig(), 1.0, 1.0) == {}


def test_what_the_settings_refuse_is_no_way():
    """The actor alone proposes plans: none goes on from the one before."""
    guided = CEMConfig(num_candidates=20, num_policy_candidates=20)
    assert calmer(guided, 1.0) == {}


def test_where_plans_promise_nothing_there_is_no_margin_to_try():
    assert leaving(CEMConfig(), 1e-4, 0.5) == {}
    narrow = calmer(replace(CEMConfig(), init_std=0.02), 0.5)
    assert all("init_std" not in changes for changes in narrow.values())


def test_the_fast_budget_is_that_of_the_settings():
    fast = read_run_config(load_config("pendulum", overrides=["budget=fast"])).planner
    changes = faster(CEMConfig(50, optim_steps=9, num_candidates=900, top_k=90), {})
    assert changes == {name: getattr(fast, name) for name in changes}
    assert len(changes) == 5


def test_the_limits_are_those_of_the_fast_budget() -> None:
    planner = load_config("pendulum", overrides=["budget=fast"])["planner"]
    assert {name: planner[name] for name in FAST_LIMITS} == FAST_LIMITS
