"""The episodes that choose the actor to keep, and those in a simulated world, for the log alone."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.agents import Layers, Scales, act, scaled
from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.worlds import World

DOING = "playing the actor"
"""What a run says that it is doing while this is on its stack."""


class Played(NamedTuple):
    """What an actor earned.

    Args:
        returns: its returns ``[N]``, in the units of training; minus infinity where it left the
            finite numbers.
        change: mean sum of the changes of its action in an episode, in half-ranges.
    """

    returns: Tensor
    change: float


class ActorEvaluation:
    """Plays the noise-free actor from the task's resets, in the model and in a simulated world.

    Args:
        rollouts: rollouts of an actor in the model, in the units of ``scales``.
        scales: those units; the returns are in physical ones.
        config: settings of the phase.
        world: the real world, if there is one.
        seed: seed of the world's episodes.
        generator: source of the model's start states.
        compile: whether to compile the episodes in the world.
    """

    def __init__(
        self,
        rollouts: Rollouts,
        scales: Scales,
        config: PolicyConfig,
        *,
        world: World | None,
        seed: int,
        generator: torch.Generator,
        compile: bool,
    ) -> None:
        task = rollouts.task
        self.rollouts, self.scales = rollouts, scales
        self.steps = config.evaluation_steps or task.max_steps
        self.states = task.sample_start([config.evaluation_episodes], generator)
        self.signals = self._draw_signals(task, config.evaluation_episodes, seed)
        truth = None if world is None or not config.real_evaluation_episodes else world.model()
        self.world = None
        if truth is not None:
            truth = scaled(truth, scales)
            self.world = Rollouts(truth, act, rollouts.max_age, compile=compile)
        # The world's episodes have a generator of their own: the log has no part in the training.
        self.world_states = task.sample_start(
            [config.real_evaluation_episodes], torch.Generator().manual_seed(seed)
        )
        self.world_signals = self._draw_signals(task, config.real_evaluation_episodes, seed)

    def imagined(self, actor: Layers) -> Played:
        """What the actor earns in the model."""
        return self._play(self.rollouts, actor, self.states, self.signals)

    def real(self, actor: Layers) -> dict[str, float]:
        """Mean return in the simulated world, to log; nothing without one."""
        if self.world is None:
            return {}
        played = self._play(self.world, actor, self.world_states, self.world_signals)
        return {"policy/real_return": self.mean(played.returns)}

    def mean(self, returns: Tensor) -> float:
        """Their mean in physical units."""
        return self.scales.reward * returns.mean().item()

    def _draw_signals(self, task: Task, episodes: int, seed: int) -> Tensor | None:
        """References and inputs of episodes, ``[1 + steps, episodes, size]``, if there are any."""
        if not task.outside:
            return None
        generator, steps = torch.Generator().manual_seed(seed), 1 + self.steps
        drawn = task.outside.draw([episodes], steps, generator)
        return task.outside.windows(drawn, 0, steps)

    def _play(
        self, world: Rollouts, actor: Layers, states: Tensor, signals: Tensor | None
    ) -> Played:
        later = None
        if signals is not None:
            states, later = world.task.with_signals(states, signals[0]), signals[1:]
        played = world.returns(actor, states, self.steps, signals=later)
        # Neither NaN nor an infinite return may win.
        returns = torch.where(played.total.isfinite(), played.total, -math.inf)
        return Played(returns, played.change.mean().item())
