"""Acrobot and AcrobotSwingup (paper, appendix B; docs/tasks.md lists its misprints).

AcrobotSwingup's reward is half of the printed one, because the published return of 371 in 500 steps
is consistent with that alone.
"""

from __future__ import annotations

from math import pi

from torch import Tensor

from phihp_torchrl.systems import Acrobot, ElbowAcrobot
from phihp_torchrl.tasks.base import Task
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.registry import register_task

GOAL_HEIGHT = 1.0
"""Height of the tip over the hinge that ends an Acrobot episode, in link lengths."""


def tip_height(state: Tensor) -> Tensor:
    """Height of the arm's tip over its hinge, -cos theta1 - cos(theta1 + theta2), ``[*batch]``."""
    theta1, theta2 = state[..., 0], state[..., 1]
    return -theta1.cos() - (theta1 + theta2).cos()


def above_goal(next_state: Tensor) -> Tensor:
    """Whether the tip is above the goal height, bool ``[*batch]``."""
    return tip_height(next_state) > GOAL_HEIGHT


def goal_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """-1 for every step, 0 for the one that reaches the goal."""
    return above_goal(next_state).to(next_state.dtype) - 1.0


def height_reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Half the tip's height, after the step."""
    return 0.5 * tip_height(next_state)


_VELOCITY_LIMITS = {"theta1_dot": 4 * pi, "theta2_dot": 9 * pi}
_HANGING = Box.around((0.0,) * 4, (0.1,) * 4)

register_task(
    Task(
        name="acrobot",
        system=ElbowAcrobot(),
        action_high=(1.0,),
        time_step=0.2,
        max_steps=500,
        reset=_HANGING,
        reward=goal_reward,
        terminated=above_goal,
        velocity_limits=_VELOCITY_LIMITS,
        coverage=Box.around((0.0,) * 4, (pi, pi, 4.0, 8.0)),
        exploration_reward=height_reward,
    )
)
register_task(
    Task(
        name="acrobot-swingup",
        system=Acrobot(),
        action_high=(1.0, 1.0),
        time_step=0.2,
        max_steps=500,
        reset=_HANGING,
        reward=height_reward,
        velocity_limits=_VELOCITY_LIMITS,
        coverage=Box.around((0.0,) * 4, (pi, pi, 5.0, 8.0)),
        goal=Box.around((pi, 0.0, 0.0, 0.0), (0.5, 0.5, 1.0, 1.0)),
    )
)
