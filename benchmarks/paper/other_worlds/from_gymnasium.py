"""gymnasium's MountainCarContinuous-v0 and Pendulum-v1 as a user writes them, guesses 30 % off."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import gymnasium
import numpy as np
import torch
from torch import Tensor

from phihp_torchrl import Box, System, Task
from phihp_torchrl.systems import Pendulum, wrap


class MountainCar(System):
    """A car in a valley with its bottom at x = -0.52: x'' = motor * push - slope * cos(3 x)."""

    state_names, action_names = ("x", "x_dot"), ("push",)
    velocity_of = {"x": "x_dot"}
    default_constants = {"motor": 0.2, "slope": 0.18}

    def prior(self, state: Tensor, action: Tensor, constants):  # type: ignore[no-untyped-def]
        """The push of the motor and the pull of the slope."""
        push = constants["motor"] * action[..., 0]
        return torch.stack(
            [state[..., 1], push - constants["slope"] * (3 * state[..., 0]).cos()], -1
        )


class CarPerStep(MountainCar):
    """The same car as the environment shows it: time in steps, speeds of at most 0.07 a step."""

    default_constants = {"motor": 0.002, "slope": 0.0018}


def plain_car_env() -> gymnasium.Env:
    """As it is."""
    return gymnasium.make("MountainCarContinuous-v0")


def mountain_car_env() -> gymnasium.Env:
    """A step counts as 0.1 s, so velocities per step become ten times as large per second."""
    env = gymnasium.make("MountainCarContinuous-v0")
    space = gymnasium.spaces.Box(np.array([-1.2, -0.7]), np.array([0.6, 0.7]), dtype=np.float32)
    units = np.array([1.0, 10.0], dtype=np.float32)
    return gymnasium.wrappers.TransformObservation(env, lambda seen: seen * units, space)


def pendulum_v1_env() -> gymnasium.Env:
    """As it is."""
    return gymnasium.make("Pendulum-v1")


def arrived(state: Tensor) -> Tensor:
    """Whether the car is on the hill."""
    return state[..., 0] >= 0.45


def mountain_car_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """The environment's own."""
    return 100.0 * arrived(next_state) - 0.1 * action[..., 0].square()


def speed(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Motion, to collect by."""
    return next_state[..., 1].square()


def pendulum_v1_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """The environment's own."""
    theta, theta_dot = state.unbind(-1)
    cost = wrap(theta).square() + 0.1 * theta_dot.square()
    return -cost - 0.001 * action[..., 0].square()


MOUNTAIN_CAR = Task(
    name="gym-mountain-car",
    system=MountainCar(),
    action_high=(1.0,),
    time_step=0.1,
    max_steps=300,
    velocity_limits={"x_dot": 0.7},
    position_limits={"x": (-1.2, 0.6)},
    reset=Box((-0.6, 0.0), (-0.4, 0.0)),
    coverage=Box((-1.2, -0.7), (0.45, 0.7)),
    reward=mountain_car_reward,
    terminated=arrived,
    exploration_reward=speed,
)
PLAIN_CAR = replace(
    MOUNTAIN_CAR,
    name="gym-mountain-car-as-it-is",
    system=CarPerStep(),
    time_step=1.0,
    max_steps=999,
    velocity_limits={"x_dot": 0.07},
    coverage=Box((-1.2, -0.07), (0.45, 0.07)),
)
PENDULUM_V1 = Task(
    name="gym-pendulum",
    system=Pendulum({"gravity": 10.0, "mass": 1.3, "length": 0.7}),
    action_high=(2.0,),
    time_step=0.05,
    max_steps=200,
    velocity_limits={"theta_dot": 8.0},
    reset=Box.around((0.0, 0.0), (pi, 1.0)),
    coverage=Box.around((0.0, 0.0), (pi, 8.0)),
    reward=pendulum_v1_reward,
)
