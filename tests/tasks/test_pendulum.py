"""The pendulums' reward and step, by hand."""

from __future__ import annotations

from math import pi

import pytest
import torch

from phihp_torchrl.worlds import SimulatedWorld

from .by_hand import rewards


@pytest.mark.parametrize("name", ["pendulum", "pendulum-swingup"])
def test_the_reward_is_of_the_state_before_the_step(name):
    state = [[pi / 2 + 2 * pi, 2.0], [0.0, 0.0], [pi, 0.0], [-0.1, -1.0]]
    action = [[1.0], [0.0], [-2.0], [0.5]]
    expected = [
        -(pi**2 / 4 + 0.1 * 4 + 0.001),
        0.0,
        -(pi**2 + 0.001 * 4),
        -(0.01 + 0.1 + 0.001 * 0.25),
    ]
    assert rewards(name, state, action, [[9.0, 9.0]] * 4) == pytest.approx(expected)


def test_a_step_by_hand():
    # At 90 degrees with 1 N·m: 15 sin + 3 a - 0.5 omega = 15 + 3 - 1 = 17 rad/s².
    world = SimulatedWorld("pendulum")
    new = world.step(torch.tensor([pi / 2, 2.0]), torch.tensor([1.0]))
    assert new.tolist() == pytest.approx([pi / 2 + 0.05 * 2.85, 2.85])
