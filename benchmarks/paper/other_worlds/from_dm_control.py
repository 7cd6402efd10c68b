"""dm_control's cart-pole, pendulum and acrobot as a user writes them: textbook, guesses 30 % off.

Friction is left out of the equations, as a user does not know it.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from other_worlds.arranged import dm_control_env
from phihp_torchrl import Box, Constant, System, Task
from phihp_torchrl.systems import CartPole, ElbowAcrobot, terms

RAIL = 1.8
"""Half the length of the rail, m."""


class PointPendulum(System):
    """A mass on a light rod, upright at 0: θ'' = (g / l) sin θ + a / (m l²)."""

    state_names, action_names = ("theta", "theta_dot"), ("torque",)
    angles, velocity_of = ("theta",), {"theta": "theta_dot"}
    default_constants = {"gravity": Constant(9.81, fixed=True), "mass": 1.3, "length": 0.65}

    def prior(self, state: Tensor, action: Tensor, constants):  # type: ignore[no-untyped-def]
        """The textbook's equation."""
        theta, theta_dot = state.unbind(-1)
        c = constants
        pull = c["gravity"] / c["length"] * theta.sin()
        return torch.stack([theta_dot, pull + action[..., 0] / (c["mass"] * c["length"] ** 2)], -1)


class RailCartPole(CartPole):
    """A cart-pole on a rail with soft stops at both ends."""

    default_constants = {
        "gravity": Constant(9.81, fixed=True),
        "cart_mass": 1.3,
        "pole_mass": 0.07,
        "half_length": 0.65,
        "stiffness": 210.0,
        "damping": 18.0,
        "share": Constant(0.7, low=0.0, high=1.0),
    }

    def prior(self, state: Tensor, action: Tensor, constants):  # type: ignore[no-untyped-def]
        """The textbook's equations, and what the stops do to cart and pole."""
        rate, c = super().prior(state, action, constants), constants
        x, x_dot, _, _ = state.unbind(-1)
        stops = c["stiffness"], c["damping"], c["share"]
        held = terms.soft_stop(rate[..., 1], x, x_dot, -RAIL, RAIL, *stops)
        return rate + held.unsqueeze(-1) * self.impulse("x", state, constants)


def cartpole_env(task: str = "swingup") -> EnvBase:
    """dm_control shows x, cos, sin, x_dot, theta_dot; its motor gives 10 N."""

    def arrange(x, cos, sin, v, omega):  # type: ignore[no-untyped-def]
        return [x, v, cos, sin, omega]

    return dm_control_env("cartpole", arrange, size=5, unit=10.0, task=task)


def pendulum_env() -> EnvBase:
    """dm_control shows cos, sin and theta_dot."""
    return dm_control_env("pendulum", lambda cos, sin, omega: [cos, sin, omega], size=3)


def acrobot_env() -> EnvBase:
    """dm_control measures both links from upright; the second angle here is that of the elbow."""

    def arrange(sin1, sin2, cos1, cos2, omega1, omega2):  # type: ignore[no-untyped-def]
        elbow = [cos2 * cos1 + sin2 * sin1, sin2 * cos1 - cos2 * sin1]
        return [-cos1, -sin1, *elbow, omega1, omega2]

    return dm_control_env("acrobot", arrange, size=6, unit=2.0)


def cartpole_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """dm_control's, summed over two steps: upright, in the middle, slow, with little force."""
    x, _, theta, theta_dot = next_state.unbind(-1)
    upright = (1.0 + theta.cos()) / 2.0
    effort = (5.0 - (action[..., 0] / 10.0).square()) / 5.0
    centered = (1.0 + 0.1 ** (x / 2.0).square()) / 2.0
    slow = (1.0 + 0.1 ** (theta_dot / 5.0).square()) / 2.0
    return 2.0 * upright * effort * centered * slow


def cartpole_sparse_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """dm_control's, summed over two steps: within 5.7 degrees of upright, 0.25 m of the middle."""
    x, _, theta, _ = next_state.unbind(-1)
    return 2.0 * ((theta.cos() >= 0.995) & (x.abs() <= 0.25)).to(state.dtype)


def pole_height(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Height of the pole, to collect by."""
    return next_state[..., 2].cos()


def pendulum_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """dm_control's, summed over two steps: within 8 degrees of upright."""
    return 2.0 * (next_state[..., 0].cos() > 0.9903).to(state.dtype)


def swing(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Height of the mass, to collect by."""
    return next_state[..., 0].cos()


def acrobot_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """dm_control's, summed over two steps: the tip within 0.2 m of its place, or near it."""
    first, total = next_state[..., 0], next_state[..., 0] + next_state[..., 1]
    height, side = -first.cos() - total.cos(), first.sin() + total.sin()
    distance = ((2.0 - height).square() + side.square()).sqrt()
    return 2.0 * 0.1 ** (distance - 0.2).clamp_min(0.0).square()


CARTPOLE = Task(
    name="dm-cartpole",
    system=RailCartPole(),
    action_high=(10.0,),
    time_step=0.02,
    max_steps=500,
    reset=Box.around((0.0, 0.0, pi, 0.0), (0.03, 0.03, 0.03, 0.03)),
    coverage=Box.around((0.0, 0.0, 0.0, 0.0), (1.8, 4.0, pi, 10.0)),
    reward=cartpole_reward,
)
BALANCE = replace(
    CARTPOLE,
    name="dm-cartpole-balance",
    reset=Box.around((0.0, 0.0, 0.0, 0.0), (0.1, 0.03, 0.034, 0.03)),
)
SPARSE, BALANCE_SPARSE = (
    replace(
        task,
        name=f"{task.name}-sparse",
        reward=cartpole_sparse_reward,
        exploration_reward=pole_height,
    )
    for task in (CARTPOLE, BALANCE)
)
PENDULUM = Task(
    name="dm-pendulum",
    system=PointPendulum(),
    action_high=(1.0,),
    time_step=0.04,
    max_steps=500,
    reset=Box.around((0.0, 0.0), (pi, 0.01)),
    coverage=Box.around((0.0, 0.0), (pi, 9.0)),
    reward=pendulum_reward,
    exploration_reward=swing,
)
ACROBOT = Task(
    name="dm-acrobot",
    system=ElbowAcrobot(
        {
            "gravity": 9.81,
            "mass1": 1.3,
            "mass2": 0.7,
            "length1": 1.0,
            "center1": 0.65,
            "center2": 0.35,
            "inertia1": 0.13,
            "inertia2": 0.07,
        }
    ),
    action_high=(2.0,),
    time_step=0.02,
    max_steps=500,
    reset=Box.around((0.0, 0.0, 0.0, 0.0), (pi, pi, 0.01, 0.01)),
    coverage=Box.around((0.0, 0.0, 0.0, 0.0), (pi, pi, 8.0, 12.0)),
    reward=acrobot_reward,
)
