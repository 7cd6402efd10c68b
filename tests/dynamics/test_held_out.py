"""What is held out of the real data: whole blocks, one in ten."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from phihp_torchrl import get_task
from phihp_torchrl.dynamics import BLOCK, DynamicsLoss, HybridDynamics, rollout_error, split
from phihp_torchrl.worlds import SimulatedWorld


def numbered(count, done=()):
    """Transitions that know their place."""
    ends = torch.zeros(count, 1, dtype=torch.bool)
    ends[list(done)] = True
    following = TensorDict(done=ends, batch_size=[count])
    return TensorDict(number=torch.arange(count), next=following, batch_size=[count])


@given(st.integers(1, 1000))
def test_nothing_is_lost_and_nothing_is_in_both(count):
    train, held_out, blocks = split(numbered(count))
    kept, held = train["number"].tolist(), held_out["number"].tolist()
    assert held
    if count > 1:
        assert sorted(kept + held) == list(range(count))
    else:
        assert kept == held == [0]
    if count >= 10 * BLOCK:
        assert blocks.shape == (count // BLOCK // 10, BLOCK)
        assert set(blocks["number"].flatten().tolist()) <= set(held)
        assert (blocks["number"].diff(dim=-1) == 1).all()
    else:
        assert blocks is None


def test_every_tenth_block_is_held_out():
    _, held_out, blocks = split(numbered(400))
    expected = [*range(180, 200), *range(380, 400)]
    assert held_out["number"].tolist() == expected
    assert blocks["number"].flatten().tolist() == expected


@pytest.mark.parametrize(("done", "whole"), [(185, [380]), (199, [180, 380]), (100, [180, 380])])
def test_a_block_in_which_an_episode_ended_is_no_rollout(done, whole):
    _, held_out, blocks = split(numbered(400, [done]))
    assert len(held_out) == 40
    assert blocks["number"][:, 0].tolist() == whole


def test_without_a_whole_block_there_is_none():
    assert split(numbered(400, [185, 385]))[2] is None


def test_the_truth_does_not_stray():
    task = get_task("pendulum")
    world = SimulatedWorld(task)
    data = world.make_batch([3], seed=0).rollout(BLOCK)
    assert rollout_error(DynamicsLoss(world.oracle()), data) < 1e-3
    loss = DynamicsLoss(HybridDynamics.pure_prior(task))
    strayed = [rollout_error(loss, block.unsqueeze(0)) for block in data]
    assert rollout_error(loss, data).item() == pytest.approx(torch.stack(strayed).mean().item())
    assert min(strayed) > 1e-2
