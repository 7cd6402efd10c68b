"""What is held out of the real data, and how far a model strays on it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics
from phihp_torchrl.dynamics import DynamicsLoss, rollout_error, split

from .trainer_parts import PENDULUM


def numbered(count, ends=()):
    number = torch.arange(count).float().unsqueeze(-1)
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[list(ends)] = True
    following = TensorDict(done=done, batch_size=[count])
    return TensorDict(number=number, next=following, batch_size=[count])


def numbers(data):
    return data["number"][..., 0].int().tolist()


def test_an_unfinished_block_is_held_out_but_no_rollout():
    train, held_out, blocks = split(numbered(390))
    assert numbers(held_out) == [*range(180, 200), *range(380, 390)]
    assert len(train) == 360
    assert numbers(blocks) == [list(range(180, 200))]
    _, held_out, blocks = split(numbered(190))
    assert numbers(held_out) == list(range(180, 190))
    assert blocks is None


def test_blocks_are_whole_episodes_parts():
    *_, blocks = split(numbered(600, ends=[185, 399]))
    # One that ends before its last step is broken, one that ends with it is not.
    assert numbers(blocks) == [list(range(380, 400)), list(range(580, 600))]
    *_, blocks = split(numbered(200, ends=[190]))
    assert blocks is None


@pytest.mark.parametrize("count", [1, 2, 9, 10, 25, 180])
def test_few_transitions_are_split_too(count):
    train, held_out, blocks = split(numbered(count))
    assert blocks is None
    if count >= 10:
        assert numbers(held_out) == list(range(9, count, 10))
    else:
        assert numbers(held_out) == [count - 1]
    if count > 1:
        assert sorted(numbers(train) + numbers(held_out)) == list(range(count))
    else:
        assert numbers(train) == [0], "one transition serves as both"


def test_rollout_error_by_hand():
    # A model of standing still is off by the whole way.
    class Standstill(torch.nn.Module):
        def forward(self, state, action):
            return torch.zeros_like(state)

    observe = PENDULUM.observe
    state = torch.zeros(2, 20, 2)
    next_state = torch.zeros(2, 20, 2)
    next_state[0, -1] = torch.tensor([0.3, 0.4])
    next_state[1, -1] = torch.tensor([0.0, 1.5])
    blocks = TensorDict(
        observation=observe(state),
        action=torch.zeros(2, 20, 1),
        next=TensorDict(observation=observe(next_state), batch_size=[2, 20]),
        batch_size=[2, 20],
    )
    loss = DynamicsLoss(HybridDynamics(PENDULUM, prior=Standstill(), residual=None))
    assert rollout_error(loss, blocks).item() == pytest.approx((0.5 + 1.5) / 2)
