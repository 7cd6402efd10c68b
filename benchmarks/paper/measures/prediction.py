"""How well a model predicts states that its data never visited."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import HybridDynamics
from phihp_torchrl.evaluation import evaluation_seed
from phihp_torchrl.worlds import SimulatedWorld

PREDICTION_STEPS = 20
"""Steps of a rollout whose last state is compared."""

PREDICTION_EPISODES = 200
"""How many rollouts are compared."""

_HOLD = 5


class UnseenEpisodes(NamedTuple):
    """Short real episodes that no training uses.

    Attributes:
        start: states ``[episodes, n]``.
        actions: actions in physical units, ``[episodes, steps, m]``.
        end: states after the last step, ``[episodes, n]``.
    """

    start: Tensor
    actions: Tensor
    end: Tensor


def unseen_episodes(world: SimulatedWorld, where: str) -> UnseenEpisodes:
    """Episodes of random actions, each held for 5 steps, by the first evaluation seed.

    Args:
        world: where they are played.
        where: ``"reset"`` for starts as the task's, ``"coverage"`` for starts in its wide box.

    Raises:
        ConfigError: for another place, or a task without such a box.
    """
    task = world.task
    boxes = {"reset": task.reset, "coverage": task.coverage}
    box = boxes.get(where)
    if box is None:
        raise ConfigError("where", f"expected a box that {task.name} has, got {where!r}.")
    generator = torch.Generator().manual_seed(evaluation_seed(0))
    start = state = box.sample([PREDICTION_EPISODES], generator=generator)
    shape = (PREDICTION_EPISODES, PREDICTION_STEPS // _HOLD, task.action_dim)
    actions = task.bounds.from_unit(2 * torch.rand(shape, generator=generator) - 1)
    actions = actions.repeat_interleave(_HOLD, dim=1)
    for action in actions.unbind(1):
        state = world.step(state, action)
    return UnseenEpisodes(start, actions, state)


def prediction_errors(world: SimulatedWorld, dynamics: HybridDynamics) -> dict[str, float]:
    """Distance ‖s − ŝ‖ after :data:`PREDICTION_STEPS` steps; raw units, angles on the circle.

    Args:
        world: the truth.
        dynamics: the model.

    Returns:
        Mean and median over :func:`unseen_episodes`, from resets and from the wide box, as
        ``reset_mean``, ``reset_median``, ``coverage_mean`` and ``coverage_median``.

    Examples:
        >>> world = SimulatedWorld("pendulum")
        >>> prediction_errors(world, world.oracle())["coverage_mean"] < 1e-4
        True
    """
    task, errors = world.task, {}
    with torch.no_grad():
        for where in ("reset", *(["coverage"] if task.coverage is not None else [])):
            start, actions, end = unseen_episodes(world, where)
            predicted = dynamics.rollout(start, actions)[:, -1]
            distance = task.difference(end, predicted).norm(dim=-1)
            errors[f"{where}_mean"] = distance.mean().item()
            errors[f"{where}_median"] = distance.median().item()
    return errors
