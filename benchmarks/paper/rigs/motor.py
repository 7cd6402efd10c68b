"""The speed of a DC motor, which has to follow a reference under a load that nobody measures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl import Box, Plant, Signal, System, Task, register_plant, register_task
from phihp_torchrl.tasks import Disturbance, Trajectories

SPEED = 50.0
"""Largest reference in rad/s."""


class Motor(System):
    """Torque and voltage: J ω' = k i - b ω, L i' = u - R i - k ω."""

    state_names = ("speed", "current")
    action_names = ("voltage",)
    default_constants = {
        "inertia": 0.01,
        "damping": 0.002,
        "torque": 0.1,
        "resistance": 1.0,
        "inductance": 0.05,
    }

    def prior(self, state: Tensor, action: Tensor, constants: Mapping[str, Any]) -> Tensor:
        inertia, damping, torque, resistance, inductance = constants.values()
        speed, current = state.unbind(-1)
        voltage = action[..., 0] - resistance * current - torque * speed
        moment = torque * current - damping * speed
        return torch.stack([moment / inertia, voltage / inductance], -1)


class MotorPlant(Plant):
    """Dry friction, and a constant torque of the load."""

    default_coefficients = {"dry": 0.05, "load": 0.0}

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        speed = state[..., 0]
        dry, load = self.coefficients["dry"], self.coefficients["load"]
        moment = -dry * (speed / 2.0).tanh() - load
        return torch.stack([moment / self.constants["inertia"], torch.zeros_like(speed)], -1)


def follow(state: Tensor, action: Tensor, next_state: Tensor, reference: Tensor) -> Tensor:
    """0 on the reference, and less the farther from it, by the first rad/s as well."""
    error = (next_state[..., 0] - reference[..., 0]).abs()
    return -((error / 20.0).square() + 0.05 * error)


def motor(preview: int, name: str) -> Task:
    """The task, with ``preview`` future values of the reference."""
    return Task(
        name=name,
        system=Motor(),
        action_high=(24.0,),
        time_step=0.02,
        max_steps=250,
        reset=Box.around((0.0, 0.0), (SPEED, 2.0)),
        reward=follow,
        coverage=Box.around((0.0, 0.0), (1.3 * SPEED, 20.0)),
        reference=Signal(
            ("speed",), (-SPEED,), (SPEED,), preview=preview, sampler=Trajectories(hold=1.5)
        ),
        disturbance=Disturbance(high={"speed": 50.0, "current": 30.0}),
    )


register_plant(Motor, MotorPlant)
register_task(motor(0, "motor"))
register_task(motor(5, "motor-preview"))
