"""An oscillator whose solution is known, and steps of the paper's worlds."""

from __future__ import annotations

import math

import torch

from phihp_torchrl import get_task
from phihp_torchrl.integrators import StateLayout, make_integrator
from phihp_torchrl.worlds import find_plant

FIXED_STEP = ["semi_implicit_euler", "rk4"]
ALL = [*FIXED_STEP, "dopri5"]
FREE = StateLayout(size=2, pairs=((0, 1),), limits=(math.inf,))
START = torch.tensor([[1.0, 0.0], [0.3, -0.8]], dtype=torch.float64)


def oscillator(state):
    """x'' = -x: the exact solution rotates the phase plane."""
    return torch.stack([state[..., 1], -state[..., 0]], -1)


def rotate(state, time):
    x, v = state.unbind(-1)
    cos, sin = math.cos(time), math.sin(time)
    return torch.stack([cos * x + sin * v, cos * v - sin * x], -1)


def error_after_one_second(integrator, steps=1, **settings):
    state = START
    for _ in range(steps):
        state = make_integrator(integrator, **settings)(oscillator, state, 1.0 / steps, FREE)
    return (state - rotate(START, 1.0)).abs().max().item()


def world(name, integrator, *, n=6, dtype=torch.float64):
    """A step function of a real world, with states and actions to step."""
    task, solve = get_task(name), make_integrator(integrator)
    plant = find_plant(task.system)
    generator = torch.Generator().manual_seed(0)
    state = task.coverage.sample([n], generator=generator, dtype=dtype)
    action = torch.rand(n, task.action_dim, generator=generator, dtype=dtype) - 0.5

    def step(state, action):
        slope = lambda s: plant.derivative(s, action)  # noqa: E731
        return solve(slope, state, task.time_step, task.layout)

    return step, state, action
