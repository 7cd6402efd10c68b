"""TD3 on real steps: the paper's model-free baseline, and the policy of its ablations."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.agents import (
    Batch,
    FlatReplay,
    Imagination,
    TD3Config,
    TD3Update,
    Worlds,
    copy_actor,
    copy_twin_qvalue,
    draw_noise,
    learning_rate_scale,
    make_td3_loss,
)
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.ranges import check_not_negative, check_positive, check_share
from phihp_torchrl.tasks import Task


@dataclass(frozen=True)
class RealTD3Config(TD3Config):
    """TD3 on real steps; its own hyper-parameters are :class:`TD3Config`'s.

    Args:
        real_steps: real transitions in all.
        batch_size: transitions in an update.
        replay_capacity: transitions kept.
        random_steps: transitions in the replay before the first update; until then actions are
            uniformly random.
        steps_per_update: real steps for each critic update.
        exploration_noise: std of the noise on actions, in units of the action bounds.
        decay: the share of the steps, at the end, over which learning rates fall to a twentieth.
        evaluation_interval: real steps between two evaluations.
        evaluation_episodes: episodes in an evaluation. They are not counted as real steps, and
            have no say in the training.
    """

    real_steps: int = 500_000
    batch_size: int = 64
    replay_capacity: int = 1_000_000
    random_steps: int = 10_000
    steps_per_update: int = 1
    exploration_noise: float = 0.1
    decay: float = 0.0
    evaluation_interval: int = 5000
    evaluation_episodes: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(
            self,
            "real_steps",
            "batch_size",
            "replay_capacity",
            "steps_per_update",
            "evaluation_interval",
            "evaluation_episodes",
        )
        check_not_negative(self, "random_steps", "exploration_noise")
        most = min(self.replay_capacity, self.real_steps)
        if self.random_steps > most:
            raise ValueError(
                f"random_steps: expected at most {most}, the lesser of replay_capacity and "
                f"real_steps, got {self.random_steps}."
            )
        check_share(self, "decay")
        if self.value_expansion != 1:
            raise ValueError(
                "value_expansion: expected 1, for there is no model to carry on with, "
                f"got {self.value_expansion}."
            )
        for name in ("real_steps", "evaluation_interval"):
            if getattr(self, name) % self.round_steps:
                raise ValueError(
                    f"{name}: expected a multiple of steps_per_update * policy_delay = "
                    f"{self.round_steps}, got {getattr(self, name)}."
                )

    @property
    def round_steps(self) -> int:
        """Real steps between two rounds of ``policy_delay`` critic updates and one of the actor."""
        return self.steps_per_update * self.policy_delay


class RealTD3Trainer:
    """Learns actor and critics from one real world, step by step.

    The world is stepped on its tensors, by the function that steps imagined worlds; here it steps
    the true dynamics, one world from the task's resets. Running out of steps truncates an episode
    and is never recorded as a termination. The last actor is the one that counts: to choose among
    actors would take episodes in the real world.

    Args:
        task: the task.
        config: how.
        seed: of everything random here but the networks' initial weights, which come from torch's
            global generator.
        transitions: real transitions to start the replay with, which an earlier phase has taken.
        compile: whether to compile the world's steps and the update.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> config = RealTD3Config(real_steps=40, evaluation_interval=20, random_steps=20)
        >>> trainer = RealTD3Trainer(get_task("pendulum"), config, seed=0)
        >>> while not trainer.done:
        ...     metrics = trainer.advance()
        >>> trainer.real_steps, trainer.updates
        (40, 20)
    """

    def __init__(
        self,
        task: Task,
        config: RealTD3Config,
        *,
        seed: int,
        transitions: Batch | None = None,
        compile: bool = False,
    ) -> None:
        self.task = task
        self.config = config
        world = TaskWorldModel(task, HybridDynamics.oracle(task))
        self.generator = torch.Generator().manual_seed(seed)
        self.loss = make_td3_loss(world, config)
        self.update = TD3Update(self.loss, world, config, compile=compile)
        # What imagined worlds are stepped with; this one is no imagination, it is the true one.
        self.world = Imagination(world, self.loss.max_action, task.max_steps, compile=compile)
        given = 0 if transitions is None else len(transitions.reward)
        capacity = min(config.replay_capacity, given + config.real_steps)
        self.replay = FlatReplay(capacity, task.system.state_dim, task.system.action_dim)
        if transitions is not None:
            self.replay.extend(transitions)
        self.given = given
        first = task.reset.sample([1], generator=self.generator)
        self.worlds = Worlds(first, torch.zeros(1, dtype=torch.int64))
        self.updates = 0
        self.seconds = 0.0
        # Evaluations have a generator of their own: the log has no part in the training.
        self._evaluation_states = task.reset.sample(
            [config.evaluation_episodes], generator=torch.Generator().manual_seed(seed)
        )

    @property
    def real_steps(self) -> int:
        """Real transitions that this phase has taken."""
        return self.replay.written - self.given

    @property
    def progress(self) -> tuple[int, int]:
        """Real transitions so far and in all."""
        return self.real_steps, self.config.real_steps

    @property
    def done(self) -> bool:
        """Whether the real steps are spent."""
        return self.real_steps >= self.config.real_steps

    @torch.no_grad()
    def advance(self) -> dict[str, float]:
        """Train for one evaluation interval and evaluate; returns what to log."""
        start = time.perf_counter()
        until = min(self.real_steps + self.config.evaluation_interval, self.config.real_steps)
        losses: dict[str, Tensor] = {}
        while self.real_steps < until:
            warm = len(self.replay) >= self.config.random_steps
            self._act(warm)
            if warm:
                losses = self._learn()
        returns = self.evaluate()
        self.seconds += time.perf_counter() - start
        return {
            "return_mean": returns.mean().item(),
            "return_std": returns.std().item() if len(returns) > 1 else 0.0,
            "td3/updates": float(self.updates),
            **{f"td3/{name}": value.item() for name, value in losses.items()},
            "td3/seconds": self.seconds,
        }

    def evaluate(self) -> Tensor:
        """Returns ``[evaluation_episodes]`` of the noise-free actor in the real world."""
        states, steps = self._evaluation_states, self.task.max_steps
        return self.world.returns(self.update.networks.actor, states, steps).total

    def parts(self) -> dict[str, Any]:
        """Actor and critics, as arguments of :class:`~phihp_torchrl.deployment.Agent`."""
        return {
            "actor": copy_actor(self.task, self.update.actor),
            "qvalue": copy_twin_qvalue(self.task, self.update.critics),
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {
            "update": self.update.state_dict(),
            "replay": self.replay.state_dict(),
            "worlds": list(self.worlds),
            "updates": self.updates,
            "seconds": self.seconds,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""
        self.update.load_state_dict(state["update"])
        self.replay.load_state_dict(state["replay"])
        self.worlds = Worlds(*state["worlds"])
        self.updates = state["updates"]
        self.seconds = state["seconds"]
        self.generator.set_state(state["generator"])

    def _act(self, warm: bool) -> None:
        """Take the real steps of one round."""
        starts = self.task.reset.sample([self.config.round_steps, 1], generator=self.generator)
        noise = draw_noise(
            starts,
            self.loss.max_action,
            std=self.config.exploration_noise,
            random_fraction=0.0 if warm else 1.0,
            generator=self.generator,
        )
        batch, self.worlds = self.world.chunk(self.update.networks.actor, self.worlds, noise)
        self.replay.extend(batch)

    def _learn(self) -> dict[str, Tensor]:
        """One round of updates."""
        config = self.config
        left = 1.0 - self.real_steps / config.real_steps
        scale = learning_rate_scale(left, config.decay)
        batch = self.replay.sample(config.batch_size * config.policy_delay, self.generator)
        self.updates += config.policy_delay
        return self.update(batch, scale, self.generator)
