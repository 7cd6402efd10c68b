"""A cart with a pole on a short rail, of which a log has both positions and the force."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl import Box, System, Task, register_task

GRAVITY = 9.81


class ShortRail(System):
    """The cart-pole of Barto, Sutton and Anderson (1983), the angle from hanging down."""

    state_names = ("x", "x_dot", "theta", "theta_dot")
    action_names = ("force",)
    angles = ("theta",)
    velocity_of = {"x": "x_dot", "theta": "theta_dot"}
    default_constants = {
        "cart": 0.5,
        "pole": 0.2,
        "half": 0.2,
        "cart_coulomb": 0.1,
        "pole_viscous": 0.001,
    }

    def prior(self, state: Tensor, action: Tensor, constants: Mapping[str, Any]) -> Tensor:
        cart, pole, half, coulomb, viscous = constants.values()
        _, speed, theta, turning = state.unbind(-1)
        sin, cos = theta.sin(), -theta.cos()  # of the angle from upright, pi - theta
        total, arm = cart + pole, pole * half
        force = action[..., 0] - coulomb * torch.tanh(speed / 0.005)
        force = force + arm * turning.square() * sin
        pull = GRAVITY * sin + viscous * turning / arm
        turn = (pull - cos * force / total) / (half * (4.0 / 3.0 - pole * cos.square() / total))
        return torch.stack([speed, force / total - arm * turn * cos / total, turning, -turn], -1)


def upright(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """1 where the pole stands, -1 where it hangs."""
    return -next_state[..., 2].cos()


register_task(
    Task(
        name="short-rail",
        system=ShortRail(),
        action_low=(-6.0,),
        action_high=(6.0,),
        time_step=0.01,
        max_steps=500,
        reset=Box.around((0.0, 0.0, 0.0, 0.0), (0.1, 0.1, 0.1, 0.1)),
        reward=upright,
    )
)
