"""The base of TD3 in imagination and on real steps: acting, learning from replay, checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.agents import (
    FlatReplay,
    TD3Config,
    TD3Update,
    make_td3_loss,
)
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts, SignalStream, Worlds, draw_noise


class TD3Trainer:
    """The base of trainers by TD3; subclasses decide when to act and when to learn.

    Args:
        world_model: the world to act in, a model or a simulated world.
        td3: hyper-parameters of TD3.
        seed: seed of all random numbers but the initial weights of the networks, which come from
            torch's global generator.
        compile: whether to compile the update.
    """

    replay: FlatReplay
    worlds: Worlds

    def __init__(
        self, world_model: TaskWorldModel, td3: TD3Config, *, seed: int, compile: bool
    ) -> None:
        self.task = world_model.task
        self.generator = torch.Generator().manual_seed(seed)
        self.loss = make_td3_loss(world_model, td3)
        self.update = TD3Update(self.loss, world_model, td3, compile=compile)
        self.updates = 0
        self.seconds = 0.0
        self.stream: SignalStream | None = None
        """References and inputs of the worlds, for a task that has some."""

    def _enter(self, worlds: Worlds) -> None:
        """Take these worlds, with references and inputs of their own."""
        self.worlds = worlds
        if self.task.outside:
            self.stream = SignalStream(self.task, len(worlds.age), self.generator)
            state = self.task.with_signals(worlds.state, self.stream.present())
            self.worlds = worlds._replace(state=state)

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {
            "update": self.update.state_dict(),
            "replay": self.replay.state_dict(),
            "worlds": list(self.worlds),
            "updates": self.updates,
            "seconds": self.seconds,
            "generator": self.generator.get_state(),
            **({} if self.stream is None else {"signals": self.stream.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.update.load_state_dict(state["update"])
        self.replay.load_state_dict(state["replay"])
        self.worlds = Worlds(*state["worlds"])
        self.updates = state["updates"]
        self.seconds = state["seconds"]
        self.generator.set_state(state["generator"])
        if self.stream is not None:
            self.stream.load_state_dict(state["signals"])

    def _act(
        self, world: Rollouts, starts: Tensor, *, noise: float, random_fraction: float
    ) -> None:
        """Step the worlds with noise on the actor's actions.

        Args:
            world: the rollouts that step the worlds.
            starts: start states of the episodes that begin meanwhile, ``[steps, worlds, n]``.
            noise: std of the noise, in units of the action's half-range.
            random_fraction: share of actions that are uniformly random.
        """
        drawn = draw_noise(
            starts,
            world.bounds,
            std=noise,
            random_fraction=random_fraction,
            generator=self.generator,
            signals=None if self.stream is None else self.stream.advance(len(starts)),
        )
        batch, self.worlds = world.chunk(self.update.networks.actor, self.worlds, drawn)
        self.replay.extend(batch)

    def _learn(self, batch_size: int, learning_rate_scale: float) -> dict[str, Tensor]:
        """A round of updates, the critics' on ``batch_size`` transitions each."""
        rows = batch_size * self.update.config.policy_delay
        return self.update(
            self.replay.sample(rows, self.generator), learning_rate_scale, self.generator
        )
