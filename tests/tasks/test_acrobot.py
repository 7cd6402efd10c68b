"""The arms' rewards and ends, by hand."""

from __future__ import annotations

from math import pi

import pytest
import torch

from phihp_torchrl import get_task

from .by_hand import ends, rewards


def test_rewards_are_of_the_state_after_the_step():
    hanging, flat, upright, folded = [0.0] * 4, [pi / 2, 0, 0, 0], [pi, 0, 0, 0], [pi, pi, 0, 0]
    after = [hanging, flat, upright, folded]
    before, idle = [[1.0] * 4] * 4, [[0.0]] * 4
    assert rewards("acrobot", before, idle, after) == [-1, -1, 0, -1]
    both = [[0.0, 0.0]] * 4
    assert rewards("acrobot-swingup", before, both, after) == pytest.approx([-1, 0, 1, 0], abs=1e-9)


def test_it_ends_when_its_tip_is_a_link_above_the_hinge():
    # Stretched out, the tip is at -2 cos theta1: above 1 from 120 degrees on.
    limit = 2 * pi / 3
    angles = [limit - 1e-9, limit + 1e-9, -limit + 1e-9, -limit - 1e-9, pi, 0.0]
    expected = [False, True, False, True, True, False]
    assert ends("acrobot", *([angle, 0, 0, 0] for angle in angles)) == expected


def test_exploration_is_rewarded_by_height():
    task, swingup = get_task("acrobot"), get_task("acrobot-swingup")
    state = task.coverage.sample([64])
    idle, both = torch.zeros(64, 1), torch.zeros(64, 2)
    given = task.exploration_reward(state, idle, state)
    assert torch.equal(given, swingup.reward(state, both, state))
    assert not torch.equal(given, task.reward(state, idle, state))
