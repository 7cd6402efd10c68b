"""The carts' rewards and ends, by hand."""

from __future__ import annotations

import math
from math import pi

import pytest
import torch

from phihp_torchrl import get_task
from phihp_torchrl.worlds import SimulatedWorld

from .by_hand import ends, rewards


def test_balancing_earns_one_a_step_the_failing_one_included():
    assert rewards("cartpole", [[0.0] * 4] * 2, [[0.0]] * 2, [[0.0] * 4, [9.0] * 4]) == [1.0, 1.0]


def test_swingup_reward_is_of_the_tip_after_the_step():
    # l = 0.5: the tip is at (x + sin theta, cos theta), the goal at (0, 1).
    after = [
        [0.0, 9.0, 0.0, 9.0],
        [0.0, 0.0, pi, 0.0],
        [1.0, 0.0, pi / 2, 0.0],
        [-1.0, 0, pi / 2, 0],
    ]
    expected = [1.0, math.exp(-4), math.exp(-5), math.exp(-1)]
    before = [[7.0] * 4] * 4
    assert rewards("cartpole-swingup", before, [[10.0]] * 4, after) == pytest.approx(expected)


def test_published_swingup_reward_prefers_the_pole_flat():
    after = [
        [0.0, 9.0, 0.0, 9.0],
        [0.0, 0.0, pi, 0.0],
        [-0.5, 0.0, pi / 2, 0.0],
        [1.0, 0, pi / 2, 0],
    ]
    expected = [math.exp(-0.25), math.exp(-0.25), 1.0, math.exp(-2.25)]
    before = [[7.0] * 4] * 4
    name = "cartpole-swingup-published"
    assert rewards(name, before, [[10.0]] * 4, after) == pytest.approx(expected)


def test_hanging_still_earns_389_of_the_published_reward():
    for name, expected in (
        ("cartpole-swingup-published", 500 * math.exp(-0.25)),
        ("cartpole-swingup", 500 * math.exp(-4)),
    ):
        task, world = get_task(name), SimulatedWorld(name)
        state = torch.tensor([0.0, 0.0, pi, 0.0], dtype=torch.float64)
        action = torch.zeros(1, dtype=torch.float64)
        earned = 0.0
        for _ in range(task.max_steps):
            state, reward, _ = task.transition(world.step, state, action)
            earned += reward.item()
        # Rounding moves the cart, and dry friction then rattles it by a millimetre a second.
        assert earned == pytest.approx(expected, abs=0.05)
    assert 500 * math.exp(-0.25) == pytest.approx(389, abs=0.5)


def test_the_exploration_reward_is_the_rewards_logarithm():
    task = get_task("cartpole-swingup")
    state = task.coverage.sample([64], dtype=torch.float64)
    action = torch.zeros(64, 1, dtype=torch.float64)
    given = task.exploration_reward(state, action, state)
    torch.testing.assert_close(given.exp(), task.reward(state, action, state))


def test_balancing_ends_beyond_the_track_or_twelve_degrees():
    lean = math.radians(12)
    edges = [[2.4, 0, 0, 0], [-2.4, 0, 0, 0], [0, 0, lean, 0], [0, 0, -lean, 0], [0, 99, 0, 99]]
    assert ends("cartpole", *edges) == [False] * 5
    beyond = [[2.4 + 1e-9, 0, 0, 0], [-2.4 - 1e-9, 0, 0, 0], [0, 0, lean + 1e-9, 0]]
    assert ends("cartpole", *beyond, [0, 0, -lean - 1e-9, 0]) == [True] * 4
