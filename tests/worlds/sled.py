"""A system of a user's own, and a task on it."""

from __future__ import annotations

from typing import ClassVar

import torch

from phihp_torchrl import Task
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Box


class Sled(System):
    """A mass that slides."""

    state_names = ("x", "v")
    action_names = ("force",)
    velocity_of: ClassVar = {"x": "v"}
    default_constants: ClassVar = {"mass": 2.0}

    def prior(self, state, action, constants):
        return torch.stack([state[..., 1], action[..., 0] / constants["mass"]], -1)


def sled_task(**changes):
    return Task(
        **{
            "name": "sled",
            "system": Sled(),
            "action_high": (1.0,),
            "time_step": 0.1,
            "max_steps": 5,
            "reset": Box((-1.0, 0.0), (1.0, 0.0)),
            "reward": lambda state, action, next_state: -next_state[..., 0].abs(),
            "velocity_limits": {"v": 3.0},
            **changes,
        }
    )
