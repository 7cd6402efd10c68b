"""The cart and its pole: gymnasium's equations, linear in what pushes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from physics import random_transition

from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.systems import CartPole, accelerations


@pytest.mark.parametrize("push", [0, 1])
def test_it_steps_like_gymnasiums(push):
    gym_env, system = CartPoleEnv(), CartPole()
    gym_env.kinematics_integrator = "semi-implicit euler"
    gym_env.theta_threshold_radians = math.inf
    gym_env.reset(seed=0)
    state = torch.tensor(gym_env.state)
    force = torch.tensor([20.0 * push - 10.0], dtype=torch.float64)
    step = make_integrator("semi_implicit_euler")
    for _ in range(20):
        gym_env.step(push)
        slope = lambda s: system.prior(s, force, system.constants)  # noqa: E731
        state = step(slope, state, 0.02, system.layout())
        np.testing.assert_allclose(state.numpy(), gym_env.state, rtol=1e-10, atol=1e-12)


def test_accelerations_are_linear_in_force_and_pull():
    system = CartPole()
    theta = random_transition(system)[0][:, 2]
    one, other = (torch.randn(2, 64, dtype=torch.float64) for _ in range(2))
    of = lambda force, pull: torch.stack(  # noqa: E731
        accelerations(theta, force, pull, system.constants)
    )
    torch.testing.assert_close(of(*(2 * one + other)), 2 * of(*one) + of(*other))
