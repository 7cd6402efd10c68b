"""Where a task names no goal, the states that earn most at once show where its reward is met."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Box, HybridDynamics, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import StartConfig, make_start_states, rewarding_states
from phihp_torchrl.tasks import Actuator


def upright(state, action, next_state):
    return (next_state[..., 0].cos() > 0.99).float()


def model_of(**changes):
    task = replace(get_task("pendulum-swingup"), name="sparse", reward=upright, **changes)
    return TaskWorldModel(task, HybridDynamics.pure_prior(task))


def test_they_are_where_a_sparse_reward_is_kept():
    found = rewarding_states(model_of())
    assert found.shape == (256, 2)
    # Within 8 degrees, and slow enough to stay there for ten steps.
    assert found[:, 0].abs().median() < 0.15
    assert found[:, 1].abs().median() < 1.0
    assert found[:, 0].abs().max() < 0.6
    assert found[:, 1].std() > 0.05, "not one state many times"


def test_a_reward_that_ends_an_episode_is_met_from_before_it():
    def arrived(state):
        return state[..., 1] > 5.0

    def reward(state, action, next_state):
        return 100.0 * arrived(next_state)

    model = model_of(terminated=arrived)
    model.task = replace(model.task, reward=reward)
    model = TaskWorldModel(model.task, model.transitions)
    states = rewarding_states(model)
    met = torch.zeros(len(states), dtype=torch.bool)
    for _ in range(10):
        states, _, ended = model.transition(states, torch.zeros(len(states), 1))
        met |= ended
    assert met.all()


def test_random_actions_lead_to_states_around():
    model = model_of()
    best = rewarding_states(model)
    found = rewarding_states(model, around=60)
    assert torch.equal(found[: 60 * 256], best.repeat(60, 1)), "half of them"
    assert found.shape == (2 * 60 * 256, 2)
    fallen = found[-256:]
    assert fallen[:, 0].abs().max() > 2.0, "some have fallen"
    assert fallen.unique(dim=0).shape[0] == 256
    nowhere = model_of(terminated=lambda state: state[..., 0].abs() > -1.0)
    assert rewarding_states(nowhere, around=60).unique(dim=0).shape == (256, 2)


def test_what_is_not_finite_is_not_among_them():
    def reward(state, action, next_state):
        return torch.where(next_state[..., 0] > 1.0, torch.nan, upright(state, action, next_state))

    model = model_of()
    task = replace(model.task, reward=reward)
    assert (rewarding_states(TaskWorldModel(task, model.transitions))[:, 0] < 1.1).all()


def test_seeds_and_registers():
    model = model_of(actuator=Actuator(delay_steps=2.0))
    first, again, other = (rewarding_states(model, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.shape[1] == model.task.state_dim > 2
    with pytest.raises(ConfigError, match="coverage"):
        rewarding_states(model_of(coverage=None))


def test_starts_are_drawn_from_them_by_their_share():
    task = get_task("pendulum-swingup")
    given = torch.full((3, 2), 0.25)
    shares = StartConfig(reset=0.0, coverage=0.4, goal=0.0, rewarding=0.6)
    drawn = make_start_states(task, shares, rewarding=given).sample([4000])
    assert (drawn == 0.25).all(-1).float().mean() == pytest.approx(0.6, abs=0.03)
    # Without a model that has found some, as without a box, there is no such share.
    assert make_start_states(task, shares).weights == (1.0,)
    bare = replace(task, coverage=None, reset=Box.around((0.0, 0.0), (0.1, 0.1)))
    with pytest.raises(ConfigError, match="share above 0"):
        make_start_states(bare, shares)
