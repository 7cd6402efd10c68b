"""A small task with everything from outside: a mass that follows a reference in the wind."""

from __future__ import annotations

import torch

from phihp_torchrl import Box, Signal, System, Task
from phihp_torchrl.tasks import Disturbance, Trajectories


class Mass(System):
    """m x'' = a + w, where the wind w is measured."""

    state_names = ("x", "x_dot")
    action_names = ("force",)
    input_names = ("wind",)
    velocity_of = {"x": "x_dot"}
    default_constants = {"mass": 1.0}

    def prior(self, state, action, constants):
        force, wind = action.unbind(-1)
        return torch.stack([state[..., 1], (force + wind) / constants["mass"]], -1)


class Calm(Mass):
    """The same without wind."""

    input_names = ()

    def prior(self, state, action, constants):
        return torch.stack([state[..., 1], action[..., 0] / constants["mass"]], -1)


def squared(state, action, next_state, reference):
    """0 on the reference."""
    return -(next_state[..., 0] - reference[..., 0]).square()


AIM = Signal(("x",), (-1.0,), (1.0,), sampler=Trajectories(hold=0.5))
WIND = Signal(("wind",), (-2.0,), (2.0,))


def followed(system=None, **changes):
    """The task, with other fields by name."""
    system = Calm() if system is None else system
    fields = {
        "name": "followed",
        "system": system,
        "action_high": (5.0,),
        "time_step": 0.1,
        "max_steps": 20,
        "reset": Box.around((0.0, 0.0), (0.5, 0.1)),
        "reward": squared,
        "reference": AIM,
        "inputs": WIND if system.input_names else None,
    }
    return Task(**{**fields, **changes})


def disturbed(**changes):
    """The task with a disturbance of its velocity."""
    return followed(disturbance=Disturbance(high={"x_dot": 3.0}, time=0.3), **changes)
