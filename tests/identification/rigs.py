"""Rigs whose recordings are simulated, with what a sensor and a drive do to them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.recordings import Recording
from phihp_torchrl.systems import Constant, System
from phihp_torchrl.tasks import Actuator, Box, Task


class Rod(System):
    """A rod that hangs from a geared motor: only gain / mass and length can be had from motion."""

    state_names = ("angle", "speed")
    action_names = ("volts",)
    angles = ("angle",)
    velocity_of = {"angle": "speed"}
    default_constants = {
        "mass": 0.3,
        "length": 0.3,
        "gain": 0.05,
        "viscous": 0.01,
        "gravity": Constant(9.81, fixed=True),
    }

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        c = constants
        inertia = c["mass"] * c["length"] ** 2 / 3.0
        torque = c["gain"] * action[..., 0] - c["viscous"] * state[..., 1]
        pull = c["mass"] * c["gravity"] * c["length"] / 2.0 * state[..., 0].sin()
        return torch.stack([state[..., 1], (torque - pull) / inertia], -1)


class Mass(System):
    """A mass on a spring."""

    state_names = ("x", "v")
    action_names = ("force",)
    velocity_of = {"x": "v"}
    default_constants = {"gain": 1.0, "stiffness": 4.0, "damping": 0.3}

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        c = constants
        pull = c["stiffness"] * state[..., 0] + c["damping"] * state[..., 1]
        return torch.stack([state[..., 1], c["gain"] * action[..., 0] - pull], -1)


class Undamped(Mass):
    """The same, as one may write it who forgets the damping."""

    default_constants = {"gain": 1.0, "stiffness": 4.0}

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        return super().prior(state, action, {**constants, "damping": 0.0})


ROD = {"mass": 0.24, "length": 0.36, "gain": 0.03, "viscous": 0.016}
MASS = {"gain": 1.3, "stiffness": 6.0, "damping": 0.5}


def make_task(system: System, high: float = 5.0, step: float = 0.02) -> Task:
    box = Box((0.0,) * system.state_dim, (0.1,) * system.state_dim)
    highs = (high,) * system.action_dim
    return Task("rig", system, highs, step, 500, box, lambda s, a, n: -s[..., 0].square())


def record(
    system: System,
    constants: dict[str, float],
    *,
    samples: int = 600,
    noise: tuple[float, ...] = (0.0, 0.0),
    actuator: Actuator | None = None,
    hold: int = 8,
    high: float = 5.0,
    step: float = 0.02,
    stop: float = math.inf,
    bounce: float = 0.0,
    jitter: float = 0.0,
    seed: int = 0,
    steps: int = 1,
) -> Recording:
    """Simulate steps of a random command that is held; a stop leaves a share of its speed.

    One step of the solver for a sample is off by far less than a sensor. Where there is a stop,
    which is hit between two steps, it takes four; for dry friction, ask for them.
    """
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(
        samples // hold + 1, system.action_dim, generator=generator, dtype=torch.float64
    )
    command = (high * (2.0 * draw - 1.0)).repeat_interleave(hold, 0)[:samples]
    spread = torch.rand(samples, generator=generator, dtype=torch.float64) - 0.5
    seconds = step * (1.0 + jitter * spread)
    truth = system.with_constants(constants)
    registers = actuator.rest(torch.zeros_like(command[0])) if actuator else None
    state, states, layout = torch.tensor([0.3, 0.0]).double(), [], system.layout()
    solver, steps = make_integrator("rk4"), steps if stop == math.inf else 4
    for i in range(samples):
        states.append(state)
        acting = command[i]
        if actuator is not None:
            acting, registers = actuator.step(registers, acting, float(seconds[i]))
        for _ in range(steps):
            state = solver(
                lambda s, a=acting: truth.prior(s, a, truth.constants),
                state,
                float(seconds[i]) / steps,
                layout,
            )
            if abs(float(state[0])) > stop:
                state = torch.stack([state[0].clamp(-stop, stop), -bounce * state[1]])
    measured = torch.stack(states)
    level = torch.tensor([0.0 if x != x else x for x in noise], dtype=torch.float64)
    measured += level * torch.randn(measured.shape, generator=generator, dtype=torch.float64)
    measured[:, [x != x for x in noise]] = torch.nan
    time = torch.cat([torch.zeros(1, dtype=torch.float64), seconds.cumsum(0)[:-1]])
    return Recording(time, measured, command, source="simulated")
