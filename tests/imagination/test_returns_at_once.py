"""Rewards of all steps together are those of one step after the other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import Actor, act
from phihp_torchrl.dynamics import PreparedModel, TaskWorldModel
from phihp_torchrl.imagination import Rollouts, sum_rewards, sum_rewards_at_once
from phihp_torchrl.imagination.rollouts import Returns
from phihp_torchrl.tasks import Actuator

TASKS = {
    "one that never ends": get_task("pendulum"),
    "one that ends": get_task("acrobot"),
    "one that soon ends": get_task("cartpole"),
    "one that remembers": replace(
        get_task("pendulum"),
        name="remembers",
        actuator=Actuator(delay_steps=1.5),
        action_rate_limit=20.0,
        action_rate_cost=0.3,
    ),
}


def make(task):
    torch.manual_seed(0)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    weights = [layer.detach() for layer in Actor(task, (8,)).mlp.parameters()]
    state = task.at_rest((task.coverage or task.reset).sample([12]))
    return model, [50.0 * layer for layer in weights], state  # they act boldly


@pytest.mark.parametrize("gamma", [1.0, 0.9])
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_they_are_the_same_in_one_piece_and_in_several(task, gamma):
    model, weights, state = make(task)
    bounds = task.bounds
    state = state.clone()
    state[3] = torch.nan  # lost from the first step on
    with torch.no_grad():
        prepared = model.prepared()
        assert isinstance(prepared, PreparedModel)
        expected = found = Returns.from_state(state, bounds)
        for steps in (1, 30, 7):
            expected = sum_rewards(prepared, act, weights, expected, bounds, steps, gamma)
            found = sum_rewards_at_once(prepared, act, weights, found, bounds, steps, gamma)
    assert expected.total[3].isnan()
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, equal_nan=True)
    if task.may_end:
        assert (found.weight == 0).any()
        assert (expected.total[expected.weight == 0]).isfinite().all()


def test_pieces_are_as_long_as_fits_the_cache(monkeypatch):
    model, weights, state = make(TASKS["one that ends"])
    rollouts = Rollouts(model, act, max_age=100)
    with torch.no_grad():
        whole = rollouts.returns(weights, state, steps=23)
        for rows in (5 * len(state), 1):
            monkeypatch.setattr(Rollouts, "_ROWS_AT_ONCE", rows)
            found = rollouts.returns(weights, state, steps=23)
            for ours, theirs in zip(found, whole, strict=True):
                torch.testing.assert_close(ours, theirs)
