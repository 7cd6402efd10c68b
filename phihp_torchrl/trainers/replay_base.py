"""The base of trainers with worlds and a replay: what they count, and their checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from phihp_torchrl.agents import ActorCriticUpdate, FlatReplay
from phihp_torchrl.imagination import SignalStream, Worlds
from phihp_torchrl.tasks import Task


class ReplayTrainer:
    """The base of trainers that step worlds, keep their transitions and update actor and critics.

    Subclasses set :attr:`update` and :attr:`replay`, and :meth:`enter` worlds.

    Args:
        task: the task.
        seed: seed of all random numbers but the initial weights of the networks, which come from
            torch's global generator.
    """

    update: ActorCriticUpdate
    replay: FlatReplay
    worlds: Worlds

    def __init__(self, task: Task, seed: int) -> None:
        self.task = task
        self.generator = torch.Generator().manual_seed(seed)
        self.updates = 0
        self.stream: SignalStream | None = None
        """References and inputs of the worlds, for a task that has some."""

    def enter(self, worlds: Worlds) -> None:
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
            "generator": self.generator.get_state(),
            **({} if self.stream is None else {"signals": self.stream.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.update.load_state_dict(state["update"])
        self.replay.load_state_dict(state["replay"])
        self.worlds = Worlds(*state["worlds"])
        self.updates = state["updates"]
        self.generator.set_state(state["generator"])
        if self.stream is not None:
            self.stream.load_state_dict(state["signals"])
