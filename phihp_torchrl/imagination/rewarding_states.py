"""The states of a task from which most is earned at once: starts where nobody has named a goal."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination.rollouts import Rollouts
from phihp_torchrl.imagination.start_states import BoxStates, TaskStates
from phihp_torchrl.tasks import ActionBounds

_DRAWN, _KEPT = 65_536, 256


@torch.no_grad()
def rewarding_states(world_model: TaskWorldModel, *, steps: int = 10, seed: int = 0) -> Tensor:
    """Find states of the coverage box that earn most within some steps of no action.

    A sparse reward is earned in a small part of the box, and most states there leave it at once. A
    few steps tell those in which a system can stay. Nothing real is spent on it.

    Args:
        world_model: the model.
        steps: steps in which rewards are summed.
        seed: seed of the states.

    Returns:
        The best 256 of 65,536 states, ``[256, n]``, the best first.

    Raises:
        ConfigError: for a task without a coverage box.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum-swingup")
        >>> states = rewarding_states(TaskWorldModel(task, HybridDynamics.hybrid(task)))
        >>> states.shape, bool(states[:, 0].abs().max() < 0.5)  # upright is at 0
        (torch.Size([256, 2]), True)
    """
    task = world_model.task
    if task.coverage is None:
        raise ConfigError("coverage", f"expected a box of task {task.name!r}, got None.")

    def nothing(weights: Sequence[Tensor], observation: Tensor, bounds: ActionBounds) -> Tensor:
        return bounds.clip(observation.new_zeros(len(observation), task.action_dim))

    sampler = TaskStates(task, BoxStates(task.coverage), under_way=True)
    device = world_model.like.device
    states = sampler.sample([_DRAWN], torch.Generator().manual_seed(seed)).to(device)
    total = Rollouts(world_model, nothing, steps).returns([], states, steps).total
    return states[total.nan_to_num(-torch.inf, -torch.inf, -torch.inf).topk(_KEPT).indices]
