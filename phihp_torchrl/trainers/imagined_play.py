"""Imagined episodes of a plan and of its actor from the same starts, with the same noise."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel

DOING = "playing in imagination"
"""What a run says that it is doing while this is on its stack."""


class Played(NamedTuple):
    """Imagined episodes.

    Attributes:
        states: states before each step, and after the last, ``[steps + 1, N, n]``.
        total: sums of the rewards until a termination, ``[N]``.
        lengths: steps until a termination, int64 ``[N]``.
        changes: mean change of the action from the step before in units of the half-range, 0 in the
            first step, ``[steps, N]``.
    """

    states: Tensor
    total: Tensor
    lengths: Tensor
    changes: Tensor

    def chatter(self) -> Tensor:
        """Mean change of the action in the second half of each episode, ``[N]``."""
        step = torch.arange(len(self.changes), device=self.changes.device)[:, None]
        counts = (step >= (self.lengths // 2).clamp_min(1)) & (step < self.lengths)
        return (self.changes * counts).sum(0) / counts.sum(0).clamp_min(1)


@torch.no_grad()
def play(agent: Agent, world_model: TaskWorldModel, state: Tensor, *, seed: int = 0) -> Played:
    """Let an agent play whole imagined episodes.

    Args:
        agent: the agent.
        world_model: the model to imagine with.
        state: first states, ``[N, n]``.
        seed: seed of the noise of its plans.
    """
    if agent.planner is not None:
        agent.planner.generator = torch.Generator(state.device).manual_seed(seed)
    agent.reset()
    scale = world_model.task.bounds.scale.to(state.device)
    states, changes = [state], list[Tensor]()
    last: Tensor | None = None
    alive = torch.ones(len(state), dtype=torch.bool, device=state.device)
    total, lengths = torch.zeros_like(state[:, 0]), torch.zeros_like(alive, dtype=torch.int64)
    while len(changes) < world_model.task.max_steps and alive.any():
        seen = TensorDict(
            observation=world_model.observe(state),
            is_init=torch.full([len(state), 1], last is None, device=state.device),
            batch_size=[len(state)],
        )
        action = agent(seen)["action"]
        changes.append(((action - (action if last is None else last)) / scale).abs().mean(-1))
        last = action
        following, reward, terminated = world_model.transition(state, action)
        total = total + torch.where(alive, reward, 0.0)
        lengths = lengths + alive
        alive = alive & ~terminated
        # An episode that is over stands still, so that nothing in it overflows.
        state = torch.where(alive[:, None], following, state)
        states.append(state)
    return Played(torch.stack(states), total, lengths, torch.stack(changes))
