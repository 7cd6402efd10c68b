"""A crane in newtons, kilograms and metres, which has to bring a load to a place without swing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sympy
import torch
from torch import Tensor

from phihp_torchrl import Box, LagrangianSystem, Plant, Task, register_plant, register_task

FORCE = 4000.0
"""Largest force on the trolley in N."""


class HeavyCrane(LagrangianSystem):
    """A load on a rope under a trolley; swing is 0 where the load hangs still."""

    state_names = ("x", "swing", "x_dot", "swing_dot")
    action_names = ("force",)
    angles, velocity_of = ("swing",), {"x": "x_dot", "swing": "swing_dot"}
    default_constants = {"trolley": 800.0, "load": 500.0, "rope": 8.0}

    def lagrangian(self, state: Sequence[Any], constants: Mapping[str, Any]) -> Any:
        (x, swing, x_dot, _), c, time = state, constants, sympy.Symbol("t")
        height = -c["rope"] * sympy.cos(swing)
        load = sympy.Matrix([x + c["rope"] * sympy.sin(swing), height]).diff(time)
        kinetic = c["trolley"] * x_dot**2 / 2 + c["load"] * load.dot(load) / 2
        return kinetic - c["load"] * 9.81 * height

    def forces(
        self, state: Sequence[Any], action: Sequence[Any], constants: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        return {"x": action[0]}


class HeavyCranePlant(Plant):
    """Drag of the rail and of the air, as rates of the velocities."""

    default_coefficients = {"rail": 0.05, "air": 0.02}

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        _, _, x_dot, swing_dot = state.unbind(-1)
        still, c = torch.zeros_like(x_dot), self.coefficients
        return torch.stack([still, still, -c["rail"] * x_dot, -c["air"] * swing_dot], -1)


def at_rest_in_place(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """0 at rest at x = 0; a metre costs as much as 0.22 rad, 1 m/s, or half of the force."""
    x, swing, x_dot, swing_dot = next_state.unbind(-1)
    place = x.square() + 20.0 * swing.square()
    motion = x_dot.square() + 20.0 * swing_dot.square()
    return -0.1 * (place + motion + (action[..., 0] / (0.5 * FORCE)).square())


register_plant(HeavyCrane, HeavyCranePlant)
register_task(
    Task(
        name="heavy-crane",
        system=HeavyCrane(),
        action_high=(FORCE,),
        time_step=0.2,
        max_steps=100,
        reset=Box((-6.0, -0.02, 0.0, 0.0), (-4.0, 0.02, 0.0, 0.0)),
        reward=at_rest_in_place,
        coverage=Box.around((0.0, 0.0, 0.0, 0.0), (8.0, 0.6, 4.0, 0.8)),
        goal=Box.around((0.0, 0.0, 0.0, 0.0), (0.5, 0.05, 0.5, 0.05)),
    )
)
