"""A rod on a geared motor, of which a log has the angle and the voltage."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl import Box, System, Task, register_task

GRAVITY = 9.81


class GearedPendulum(System):
    """I θ'' = k u - (m g l / 2) sin θ - friction, I = m l² / 3, from hanging down."""

    state_names = ("angle", "speed")
    action_names = ("volts",)
    angles = ("angle",)
    velocity_of = {"angle": "speed"}
    default_constants = {
        "mass": 0.3,
        "length": 0.3,
        "gain": 0.05,
        "viscous": 0.01,
        "coulomb": 0.01,
    }

    def prior(self, state: Tensor, action: Tensor, constants: Mapping[str, Any]) -> Tensor:
        mass, length, gain, viscous, coulomb = constants.values()
        angle, speed = state.unbind(-1)
        friction = viscous * speed + coulomb * torch.tanh(speed / 0.02)
        pull = mass * GRAVITY * length / 2.0 * angle.sin()
        torque = gain * action[..., 0] - pull - friction
        return torch.stack([speed, torque / (mass * length**2 / 3.0)], -1)

    def identifiable(self, constants: Mapping[str, Any]) -> dict[str, Any]:
        """What motion can tell: everything over the moment of inertia."""
        mass, length, gain, viscous, coulomb = constants.values()
        inertia = mass * length**2 / 3.0
        return {
            "gain/inertia": gain / inertia,
            "1.5 g/l": 1.5 * GRAVITY / length,
            "viscous/inertia": viscous / inertia,
            "coulomb/inertia": coulomb / inertia,
        }


def upright(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """1 where the rod stands, -1 where it hangs."""
    return -next_state[..., 0].cos()


register_task(
    Task(
        name="geared-pendulum",
        system=GearedPendulum(),
        action_low=(-6.0,),
        action_high=(12.0,),
        time_step=0.02,
        max_steps=500,
        reset=Box.around((0.0, 0.0), (0.1, 0.1)),
        reward=upright,
    )
)
