"""TD-MPC's trainer: what is counted, what explores, what is kept."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from torchrl.envs.utils import ExplorationType, exploration_type

from phihp_torchrl import MPPIPlanner
from phihp_torchrl.tasks import find_task
from phihp_torchrl.tdmpc import (
    ScheduledMPPIConfig,
    TDMPCConfig,
    TDMPCTrainConfig,
    TDMPCTrainer,
    TOLDConfig,
)
from phihp_torchrl.worlds import GymnasiumConfig, SimulatedConfig

SMALL = TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8)


def make_trainer(task="pendulum", max_steps=20, world="simulated", **kwargs):
    config = TDMPCTrainConfig(
        **{
            "real_steps": 70,
            "seed_steps": 30,
            "updates_per_step": 0.2,
            "batch_size": 4,
            "replay_capacity": 500,
            "evaluation_interval": 1000,
            "learn": TDMPCConfig(told=SMALL),
            "planner": ScheduledMPPIConfig(
                optim_steps=1,
                num_candidates=8,
                top_k=2,
                num_policy_candidates=2,
                schedule_steps=60,
            ),
            **kwargs,
        }
    )
    task = replace(find_task(task), max_steps=max_steps)
    return TDMPCTrainer(task, config, seed=0, world=world)


def finish(trainer):
    metrics = []
    while not trainer.done:
        metrics.append(trainer.advance())
    return metrics


def test_steps_and_updates_are_counted_as_published():
    """Two random episodes, then as many updates as they had steps; then an episode, its updates."""
    trainer = make_trainer(updates_per_step=1.0)
    metrics = finish(trainer)
    lengths = [m["tdmpc/episode_length"] for m in metrics if "tdmpc/episode_length" in m]
    updates = [m["tdmpc/updates"] for m in metrics if "tdmpc/updates" in m]
    assert lengths == [20, 20, 20, 10]  # the last is cut off where the steps are used up
    assert updates == [40, 60, 70]
    assert trainer.real_steps == 70
    assert trainer.progress == (70, 70)
    horizons = [m["tdmpc/planning_horizon"] for m in metrics if "tdmpc/episode_length" in m]
    assert horizons == [0, 0, 3, 5]  # 40 and 60 of the schedule's 60 steps


def test_updates_per_step_keeps_fractions():
    trainer = make_trainer(updates_per_step=0.15)
    metrics = finish(trainer)
    updates = [m["tdmpc/updates"] for m in metrics if "tdmpc/updates" in m]
    assert updates == [6, 9, 10]  # of 6, 3 and 1.5
    assert trainer.progress == (70, 70), "half an update is never due"


def test_episodes_end_where_the_task_ends_them():
    trainer = make_trainer(
        "cartpole", max_steps=500, real_steps=150, seed_steps=100, updates_per_step=0.1
    )
    finish(trainer)
    rows = trainer.replay.buffer.storage[:]
    ends = rows["next", "terminated"][:, 0]
    assert ends.sum() >= 4
    # What follows a termination is padding, one row less than a slice.
    for i in ends.nonzero()[:, 0].tolist():
        assert rows["valid"][i]
        assert not rows["valid"][i + 1 : i + 5].any()
    assert rows["valid"].sum() == 150


def test_evaluation_has_no_part_in_the_training():
    plain, evaluated = make_trainer(), make_trainer(evaluation_interval=20, evaluation_episodes=2)
    torch.manual_seed(1)
    evaluated.told.load_state_dict(plain.told.state_dict())
    evaluated.update.loss.target.load_state_dict(plain.update.loss.target.state_dict())
    finish(plain)
    metrics = finish(evaluated)
    assert sum("return_mean" in m for m in metrics) == 3
    for ours, theirs in zip(plain.told.parameters(), evaluated.told.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_training_explores_and_the_agent_does_not(monkeypatch):
    trainer = make_trainer(evaluation_interval=20, evaluation_episodes=1)
    kinds = {}
    plan_once = MPPIPlanner.planning

    def spy(planner, *args):
        kinds.setdefault(planner is trainer.planner, set()).add(exploration_type())
        return plan_once(planner, *args)

    monkeypatch.setattr(MPPIPlanner, "planning", spy)
    finish(trainer)
    assert kinds[True] == {ExplorationType.RANDOM}
    assert ExplorationType.RANDOM not in kinds[False]


def test_a_trainer_goes_on_from_its_state():
    """To the bit, from the middle of a training."""
    ours = make_trainer()
    for _ in range(4):
        ours.advance()
    state = copy.deepcopy(ours.state_dict())
    torch.manual_seed(7)
    theirs = make_trainer()
    theirs.load_state_dict(state)
    assert theirs.progress == ours.progress
    for trainer in (ours, theirs):
        torch.manual_seed(3)
        finish(trainer)
    assert ours.real_steps == theirs.real_steps == 70
    for mine, yours in zip(ours.told.parameters(), theirs.told.parameters(), strict=True):
        assert torch.equal(mine, yours)


@pytest.mark.parametrize(
    "world",
    [
        {"kind": "simulated", "integrator": "rk4", "friction": {"joint": 0.0}},
        SimulatedConfig(),
        GymnasiumConfig("Pendulum-v1"),
    ],
)
def test_it_learns_in_any_world(world):
    trainer = make_trainer(
        world=world, real_steps=45, evaluation_interval=20, evaluation_episodes=1
    )
    metrics = finish(trainer)
    assert trainer.progress == (45, 45)
    returns = [m["return_mean"] for m in metrics if "return_mean" in m]
    assert len(returns) == 2
    assert all(-400 < value < 0 for value in returns)
    kind = world["kind"] if isinstance(world, dict) else world.kind
    assert trainer.world.kind == kind


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("real_steps", 0),
        ("seed_steps", -1),
        ("updates_per_step", 0.0),
        ("batch_size", 0),
        ("replay_capacity", 5),
        ("priority_alpha", -0.1),
        ("evaluation_interval", 0),
    ],
)
def test_values_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        TDMPCTrainConfig(**{name: value})
