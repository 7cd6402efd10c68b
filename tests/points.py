"""The smallest world that planners are tested in: a point on a plane."""

from __future__ import annotations

from math import inf

import torch

from phihp_torchrl.planners import Problem
from phihp_torchrl.tasks import ActionBounds

ZEROS = torch.zeros(2, dtype=torch.float64)


class Point:
    """A point on a plane that moves by its action and wants to be at ``goal``."""

    def __init__(self, goal=0.3, wall=inf, reward=None):
        self.goal, self.wall, self.reward = goal, wall, reward

    def locate(self, observation):
        return observation

    def observe(self, state):
        return state

    def transition(self, state, action):
        next_state = state + action
        reward = -(next_state - self.goal).square().sum(-1)
        if self.reward is not None:
            reward = self.reward(state, action, reward)
        return next_state, reward, (next_state.abs() > self.wall).any(-1)


def half_way(observation):
    """An actor that goes half of the way to the goal."""
    return 0.5 * (0.3 - observation)


def bounds(low=(-1.0, -0.5), high=(1.0, 0.75), dtype=torch.float64):
    return ActionBounds.from_limits(torch.tensor(low, dtype=dtype), torch.tensor(high, dtype=dtype))


def point_problem(actor=None, value=None, limits=None, **kwargs):
    """Planning for a :class:`Point` of these ``kwargs``, within ``limits`` or :func:`bounds`."""
    return Problem(model=Point(**kwargs), bounds=limits or bounds(), actor=actor, value=value)
