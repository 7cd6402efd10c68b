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
# Chance that a random action changes at a step; held ones move slow systems too.
_CHANGE = 0.1


@torch.no_grad()
def rewarding_states(
    world_model: TaskWorldModel, *, steps: int = 10, around: int = 0, seed: int = 0
) -> Tensor:
    """Find states of the coverage box that earn most within some steps of no action.

    A sparse reward is earned in a small part of the box, and most states there leave it at once. A
    few steps tell those in which a system can stay. Nothing real is spent on it.

    From those states random actions lead to others, and from these there is often a way back: a
    pendulum that has fallen has the energy to rise (Florensa et al., 2017, draw their starts so).

    Args:
        world_model: the model.
        steps: steps in which rewards are summed.
        around: steps of random actions, each of which adds 256 states; 0 for none.
        seed: seed of the states.

    Returns:
        The best 256 of 65,536 states, the best first, ``[256, n]``; with ``around``, these as often
        as there are steps, and those around but for the ends of episodes, ``[N, n]``.

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
    generator = torch.Generator().manual_seed(seed)
    device = world_model.like.device
    states = sampler.sample([_DRAWN], generator).to(device)
    total = Rollouts(world_model, nothing, steps).returns([], states, steps).total
    best = states[total.nan_to_num(-torch.inf, -torch.inf, -torch.inf).topk(_KEPT).indices]
    others = _around(world_model, best, around, generator)
    return torch.cat([*[best] * max(1, len(others)), *others])


def _around(
    world_model: TaskWorldModel, state: Tensor, steps: int, generator: torch.Generator
) -> list[Tensor]:
    """The states to which random actions, each held for a while, lead from these."""
    task, model = world_model.task, world_model.prepared()
    bounds = task.bounds.to(state.device)
    alive = torch.ones(len(state), dtype=torch.bool, device=state.device)
    action, found = torch.zeros(len(state), task.action_dim, device=state.device), []
    for _ in range(steps):
        unit = 2.0 * torch.rand(action.shape, generator=generator) - 1.0
        changes = torch.rand([len(state), 1], generator=generator) < _CHANGE
        action = torch.where(changes.to(state.device), bounds.from_unit(unit.to(action)), action)
        state, _, ended = model.transition(state, action)
        alive = alive & ~ended & state.isfinite().all(-1)
        found.append(state[alive])
    return found
