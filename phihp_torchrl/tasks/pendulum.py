"""Pendulum and PendulumSwingup (paper, appendix B; docs/tasks.md)."""

from __future__ import annotations

from math import pi

from torch import Tensor

from phihp_torchrl.systems import Pendulum, wrap
from phihp_torchrl.tasks.base import Task
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.registry import register_task


def upright_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """-(wrap(theta)² + 0.1 theta_dot² + 0.001 a²), of the state before the step."""
    theta, theta_dot = state.unbind(-1)
    effort = action.square().sum(-1)
    return -(wrap(theta).square() + 0.1 * theta_dot.square() + 0.001 * effort)


_COVERAGE = Box.around((0.0, 0.0), (pi, 8.0))

register_task(
    Task(
        name="pendulum",
        system=Pendulum(),
        action_high=(2.0,),
        time_step=0.05,
        max_steps=200,
        reset=Box.around((0.0, 0.0), (pi, 1.0)),
        reward=upright_reward,
        coverage=_COVERAGE,
    )
)
register_task(
    Task(
        name="pendulum-swingup",
        system=Pendulum(),
        action_high=(2.0,),
        time_step=0.05,
        max_steps=500,
        reset=Box.around((pi, 0.0), (pi / 32, 1.0)),
        reward=upright_reward,
        coverage=_COVERAGE,
    )
)
