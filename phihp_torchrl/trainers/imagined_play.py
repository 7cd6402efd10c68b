"""Imagined episodes of a plan and of its actor from the same starts, with the same noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel

DOING = "playing in imagination"
"""What a run says that it is doing while this is on its stack."""


class Played(NamedTuple):
    """A stretch of episodes.

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

    def chatter(self, start: Tensor) -> Tensor:
        """Mean change of the action from step ``start`` of each episode to its end, ``[N]``."""
        step = torch.arange(len(self.changes), device=start.device)[:, None]
        counts = (step >= start.clamp_min(1)) & (step < self.lengths)
        return (self.changes * counts).sum(0) / counts.sum(0).clamp_min(1)


class Player:
    """An agent that plays on in imagined episodes; the noise of its plans is its own.

    Args:
        agent: the agent.
        world_model: the model to imagine with.
        state: first states, ``[N, n]``.
        seed: seed of the noise of its plans.
    """

    def __init__(
        self, agent: Agent, world_model: TaskWorldModel, state: Tensor, seed: int = 0
    ) -> None:
        self.agent, self.world_model = agent, world_model
        if agent.planner is not None:
            agent.planner.generator = torch.Generator(state.device).manual_seed(seed)
        agent.reset()
        self._states = [state]
        self._alive = torch.ones(len(state), dtype=torch.bool, device=state.device)
        self._total = torch.zeros_like(state[:, 0])
        self._lengths = torch.zeros_like(self._alive, dtype=torch.int64)
        self._changes: list[Tensor] = []
        self._last: Tensor | None = None

    @torch.no_grad()
    def play(self, steps: int) -> Played:
        """Play on until ``steps`` steps are played in all, or all episodes are over.

        Returns:
            The episodes from their start.
        """
        scale = self.world_model.task.bounds.scale.to(self._total.device)
        while len(self._changes) < steps and self._alive.any():
            state, start = self._states[-1], self._last is None
            seen = TensorDict(
                observation=self.world_model.observe(state),
                is_init=torch.full([len(state), 1], start, device=state.device),
                batch_size=[len(state)],
            )
            action = self.agent(seen)["action"]
            last = action if self._last is None else self._last
            self._changes.append(((action - last) / scale).abs().mean(-1))
            self._last = action
            following, reward, terminated = self.world_model.transition(state, action)
            self._total = self._total + torch.where(self._alive, reward, 0.0)
            self._lengths = self._lengths + self._alive
            self._alive = self._alive & ~terminated
            # An episode that is over stands still, so that nothing in it overflows.
            self._states.append(torch.where(self._alive[:, None], following, state))
        none = self._total.new_zeros(0, len(self._total))
        changes = torch.stack(self._changes) if self._changes else none
        return Played(torch.stack(self._states), self._total, self._lengths, changes)

    def followed_by(self, actor: Agent, steps: int) -> Tensor:
        """Returns ``[N]`` if ``actor`` plays ``steps`` steps after what has been played."""
        return followed_by(actor, [self], steps)[0]


def followed_by(actor: Agent, players: Sequence[Player], steps: int) -> list[Tensor]:
    """Returns ``[N]`` of each if ``actor`` plays on for ``steps`` steps, all at once."""
    rest = Player(actor, players[0].world_model, torch.cat([each._states[-1] for each in players]))
    rest._alive = torch.cat([each._alive for each in players])
    totals = [each._total for each in players]
    if not steps:
        return totals
    more = rest.play(steps).total.split([len(total) for total in totals])
    return [total + extra for total, extra in zip(totals, more, strict=True)]
