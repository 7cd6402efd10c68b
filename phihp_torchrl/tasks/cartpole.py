"""CartPole, CartPoleSwingup and its published variant (paper, appendix B; docs/tasks.md).

The paper prints CartPoleSwingup's reward without the minus sign in its exponent.
"""

from __future__ import annotations

from math import pi, radians

import torch
from torch import Tensor

from phihp_torchrl.systems import CartPole
from phihp_torchrl.tasks.base import Task
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.registry import register_task

POSITION_LIMIT = 2.4
"""Largest distance of the cart from the middle, in m."""
ANGLE_LIMIT = radians(12.0)
"""Largest angle of the pole from upright, in rad."""

_SYSTEM = CartPole()
_HALF_LENGTH = _SYSTEM.constants["half_length"]


def alive_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """+1 for every step, the failing one included."""
    return torch.ones_like(next_state[..., 0])


def fallen(next_state: Tensor) -> Tensor:
    """Whether the cart left the track or the pole leans too far."""
    x, _, theta, _ = next_state.unbind(-1)
    return (x.abs() > POSITION_LIMIT) | (theta.abs() > ANGLE_LIMIT)


def approach_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """-|tip - (0, 1)|² of the pole's tip (x + 2l sin theta, 2l cos theta), after the step.

    This is the logarithm of :func:`tip_reward`, which is almost constant, near 0, wherever the pole
    hangs: a short plan for that reward does not move the pole, and the data that it collects never
    contain the upright pole.
    """
    x, _, theta, _ = next_state.unbind(-1)
    tip_x = x + 2 * _HALF_LENGTH * theta.sin()
    tip_y = 2 * _HALF_LENGTH * theta.cos()
    return -(tip_x.square() + (tip_y - 1.0).square())


def tip_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """exp(-|tip - (0, 1)|²), after the step."""
    return approach_reward(state, action, next_state).exp()


def published_tip_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """exp(-(x + l sin theta)² - (l cos theta)²), after the step: what the published runs maximise.

    It leaves out the height of the goal: a horizontal pole earns most, a hanging one 389 of 500.
    """
    x, _, theta, _ = next_state.unbind(-1)
    center_x = x + _HALF_LENGTH * theta.sin()
    center_y = _HALF_LENGTH * theta.cos()
    return torch.exp(-(center_x.square() + center_y.square()))


_UPRIGHT = Box.around((0.0,) * 4, (0.05,) * 4)
_HANGING = Box.around((0.0, 0.0, pi, 0.0), (0.05,) * 4)
_SWINGUP_COVERAGE = Box.around((0.0, 0.0, 0.0, 0.0), (3.0, 4.0, pi, 10.0))

register_task(
    Task(
        name="cartpole",
        system=_SYSTEM,
        action_high=(10.0,),
        time_step=0.02,
        max_steps=500,
        reset=_UPRIGHT,
        reward=alive_reward,
        terminated=fallen,
        coverage=Box.around((0.0,) * 4, (POSITION_LIMIT, 3.0, ANGLE_LIMIT, 3.0)),
    )
)
register_task(
    Task(
        name="cartpole-swingup",
        system=_SYSTEM,
        action_high=(10.0,),
        time_step=0.02,
        max_steps=500,
        reset=_HANGING,
        reward=tip_reward,
        coverage=_SWINGUP_COVERAGE,
        goal=Box.around((0.0,) * 4, (0.5, 1.0, 0.5, 1.5)),
        exploration_reward=approach_reward,
    )
)
register_task(
    Task(
        name="cartpole-swingup-published",
        system=_SYSTEM,
        action_high=(10.0,),
        time_step=0.02,
        max_steps=500,
        reset=_HANGING,
        reward=published_tip_reward,
        coverage=_SWINGUP_COVERAGE,
    )
)
