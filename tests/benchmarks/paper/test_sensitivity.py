"""The sweep of a planner's settings: agents of any kind, and what no planner of a kind can have."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import sensitivity
from phihp_torchrl import get_task, save_agent
from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.tasks import register_task
from phihp_torchrl.tdmpc import TOLD, TDMPCAgent, TOLDConfig

CEM = CEMConfig(
    planning_horizon=4,
    optim_steps=1,
    num_candidates=12,
    top_k=6,
    num_kept_elites=3,
    num_policy_candidates=2,
    replan_every=3,
    warm_start=True,
)
MPPI = MPPIConfig(
    planning_horizon=2, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2
)


def swept(own, **lists):
    config = sensitivity.Config(agent="", **lists)
    return {(name, value): planner for name, value, planner in sensitivity.changes(config, own)}


def test_one_setting_changes_and_what_must_go_with_it() -> None:
    found = swept(CEM, planning_horizon=(2, 6), replan_every=(1, 9), num_policy_candidates=(0,),
                  num_random_candidates=(0, 2))  # fmt: skip
    # A plan cannot be acted beyond its end.
    assert found["planning_horizon", 2] == replace(CEM, planning_horizon=2, replan_every=2)
    assert found["planning_horizon", 6] == replace(CEM, planning_horizon=6)
    assert found["replan_every", 1] == replace(CEM, replan_every=1)
    assert ("replan_every", 9) not in found
    without = found["num_policy_candidates", 0]
    assert without == replace(CEM, num_policy_candidates=0, num_candidates=10)
    none, few = found["num_random_candidates", 0], found["num_random_candidates", 2]
    assert (none.num_candidates, none.top_k, none.num_kept_elites) == (2, 2, 2)
    assert (none.warm_start, few.warm_start) == (False, True)


def test_a_planner_without_a_setting_is_not_swept_over_it() -> None:
    found = swept(MPPI, planning_horizon=(3,), replan_every=(1,), num_random_candidates=(0, 4))
    assert found == {
        ("planning_horizon", 3): replace(MPPI, planning_horizon=3),
        ("num_random_candidates", 4): replace(MPPI, num_candidates=6),
    }


@pytest.mark.parametrize(
    "lists", [{"planning_horizon": (1, 0)}, {"num_policy_candidates": (-1,)}, {"episodes": 0}]
)
def test_what_is_wrong_is_named(lists: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(lists))):
        sensitivity.Config(agent="", **lists)


def test_an_agent_of_another_kind_is_swept_too(
    run_script: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    task = replace(get_task("pendulum"), name="brief-swept", max_steps=5)
    register_task(task, replace=True)
    told = TOLD.for_task(task, TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8))
    save_agent(TDMPCAgent(task, told, MPPI, metadata={"seed": 3}), tmp_path / "agent")
    run_script(
        "sensitivity", "agent=agent", "episodes=2", "latency_actions=2", "planning_horizon=[1,3]",
        "replan_every=[1]", "num_policy_candidates=[0]", "num_random_candidates=[0]",
    )  # fmt: skip
    trials = json.loads((tmp_path / "results/sensitivity/brief-swept-seed3.json").read_text())
    settings = [(trial["setting"], trial["value"]) for trial in trials]
    assert settings == [
        ("planning_horizon", 1), ("planning_horizon", 3), ("num_policy_candidates", 0),
    ]  # fmt: skip
    assert len({trial["return_mean"] for trial in trials}) == 3
    assert "num_random_candidates=0: left out: " in capsys.readouterr().out
    alone = tmp_path / "alone"
    save_agent(TDMPCAgent(task, told), alone)
    with pytest.raises(SystemExit, match=r"^error: agent: expected one that plans"):
        run_script("sensitivity", f"agent={alone}")
