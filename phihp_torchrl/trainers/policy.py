"""Phase 2: TD3 in imagination (paper, section 4.2)."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from phihp_torchrl.agents import (
    CriticRefit,
    FlatReplay,
    Imagination,
    Worlds,
    copy_actor,
    copy_twin_qvalue,
    learning_rate_scale,
)
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.envs import make_start_states
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.td3_base import TD3Trainer


class PolicyTrainer(TD3Trainer):
    """Learns actor and critics from imagined transitions, many worlds at once.

    After every ``evaluation_interval`` updates the noise-free actor plays episodes from the task's
    resets in the model, and the best actor met is kept together with its critics. The real world
    is played in for the log alone: neither it nor an evaluation seed has a say in that choice.

    Where ``config.refit`` says so, the critics of the best actor so far are fitted to what it earns
    in the model, and training goes on from there: policy iteration, with TD3 as the improvement.
    The last fit makes the critics that the planner relies on.

    Args:
        task: the task.
        dynamics: the model to imagine with; it is not changed.
        config: phase 2.
        seed: of everything random here but the networks' initial weights, which come from torch's
            global generator.
        data_states: states of real transitions ``[N, n]``, for ``start.data`` > 0.
        compile: whether to compile the hot loops: the TD3 step, imagination, and fitting critics.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum")
        >>> config = PolicyConfig(updates=4, evaluation_interval=4, evaluation_steps=5)
        >>> trainer = PolicyTrainer(task, HybridDynamics.oracle(task), config, seed=0)
        >>> while not trainer.done:
        ...     metrics = trainer.advance()
        >>> trainer.best_actor().out_keys
        ['action']
    """

    def __init__(
        self,
        task: Task,
        dynamics: HybridDynamics,
        config: PolicyConfig,
        *,
        seed: int,
        data_states: Tensor | None = None,
        compile: bool = False,
    ) -> None:
        self.world_model = TaskWorldModel(task, dynamics)
        super().__init__(self.world_model, config.td3, seed=seed, compile=compile)
        self.config = config
        self.start_states = make_start_states(task, **vars(config.start), states=data_states)
        self.imagination = Imagination(
            self.world_model, self.loss.max_action, self.max_age, compile=compile
        )
        self.refit = CriticRefit(
            self.world_model, self.imagination, config.refit, config.td3.gamma, compile=compile
        )
        self.replay = FlatReplay(
            config.replay_capacity, task.system.state_dim, task.system.action_dim
        )
        self.worlds = self._new_worlds()
        self.best = [layer.clone() for layer in (*self.update.actor, *self.update.critics)]
        self.best_return = -math.inf
        self._evaluation_states = task.reset.sample(
            [config.evaluation_episodes], generator=self.generator
        )
        # The world's episodes have a generator of their own: the log has no part in the training.
        self._world = Imagination(
            TaskWorldModel(task, HybridDynamics.oracle(task)),
            self.loss.max_action,
            self.max_age,
            compile=compile,
        )
        self._world_states = task.reset.sample(
            [config.real_evaluation_episodes], generator=torch.Generator().manual_seed(seed)
        )

    @property
    def max_age(self) -> int:
        """Steps that an imagined life lasts at most."""
        return self.config.max_age or self.task.max_steps

    @property
    def progress(self) -> tuple[int, int]:
        """Critic updates so far and in all."""
        return self.updates, self.config.updates

    @property
    def done(self) -> bool:
        """Whether the budget of updates or seconds is spent."""
        limit = self.config.max_seconds
        return self.updates >= self.config.updates or (limit is not None and self.seconds > limit)

    @torch.no_grad()
    def advance(self) -> dict[str, float]:
        """Train for one evaluation interval and evaluate; returns what to log."""
        start = time.perf_counter()
        config = self.config
        until = min(self.updates + config.evaluation_interval, config.updates)
        losses: dict[str, Tensor] = {}
        while self.updates < until:
            round_end = config.chunk_steps * config.updates_per_step
            if self.updates % round_end == 0:
                self._imagine_chunk()
            for _ in range(min(round_end - self.updates % round_end, until - self.updates)):
                if self.updates % config.td3.policy_delay == 0:
                    left = 1.0 - self.updates / config.updates
                    scale = learning_rate_scale(left, config.decay)
                    losses = self._learn(config.batch_size, scale)
                self.updates += 1
        imagined = self._play(self.imagination, self._evaluation_states)
        # Of equal ones the later, which has learned more; none that left the finite numbers.
        if -math.inf < imagined >= self.best_return:
            self.best_return = imagined
            self._keep(self._layers())
        metrics = {
            "policy/updates": float(self.updates),
            "policy/imagined_steps": float(self.replay.written),
            "policy/imagined_return": imagined,
            "policy/best_imagined_return": self.best_return,
            **{f"policy/{name}": value.item() for name, value in losses.items()},
        }
        if config.refit.is_due(self.updates, config.updates):
            metrics |= self._refit_critics()
        if config.real_evaluation_episodes:
            metrics["policy/real_return"] = self._play(self._world, self._world_states)
        self.seconds += time.perf_counter() - start
        return {**metrics, "policy/seconds": self.seconds}

    def actor(self) -> TensorDictModule:
        """The actor as it is now."""
        return copy_actor(self.task, self.update.actor)

    def best_actor(self) -> TensorDictModule:
        """The actor with the best imagined return so far."""
        return copy_actor(self.task, self.best[: len(self.update.actor)])

    def best_qvalue(self) -> TensorDictModule:
        """The twin critics that were the best actor's."""
        return copy_twin_qvalue(self.task, self.best[len(self.update.actor) :])

    def parts(self) -> dict[str, Any]:
        """Actor and critics, as arguments of :class:`~phihp_torchrl.deployment.Agent`."""
        return {"actor": self.best_actor(), "qvalue": self.best_qvalue()}

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {
            **super().state_dict(),
            "best": list(self.best),
            "best_return": self.best_return,
            "evaluation_states": self._evaluation_states,
            "world_states": self._world_states,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""
        super().load_state_dict(state)
        for kept, layer in zip(self.best, state["best"], strict=True):
            kept.copy_(layer)
        self.best_return = state["best_return"]
        self._evaluation_states = state["evaluation_states"]
        self._world_states = state["world_states"]

    def _play(self, world: Imagination, states: Tensor) -> float:
        """Mean return of the noise-free actor; minus infinity where it left the finite numbers."""
        steps = self.config.evaluation_steps or self.task.max_steps
        score = world.returns(self.update.networks.actor, states, steps).total
        return torch.nan_to_num(score, nan=-math.inf).mean().item()

    def _keep(self, layers: list[Tensor]) -> None:
        for kept, layer in zip(self.best, layers, strict=True):
            kept.copy_(layer)

    def _refit_critics(self) -> dict[str, float]:
        """Fit the best actor's critics to its returns, and go on from these."""
        count = len(self.update.networks.actor)
        actor, critics = self.best[:count], self.best[count:]
        batch = self.replay.sample(self.config.refit.transitions, self.generator)
        refit = self.refit(actor, critics, batch.state, batch.action, self.generator)
        self._keep([*actor, *refit.critics])
        self.update.restart(actor, refit.critics)
        return {
            "policy/critic_lag": refit.lag,
            "policy/critic_error_before": refit.error_before,
            "policy/critic_error": refit.error_after,
        }

    def _layers(self) -> list[Tensor]:
        return [*self.update.actor, *self.update.critics]

    def _new_worlds(self) -> Worlds:
        count = self.config.num_worlds
        age = torch.randint(self.max_age, (count,), generator=self.generator)
        return Worlds(self.start_states.sample([count], self.generator), age)

    def _imagine_chunk(self) -> None:
        config = self.config
        while True:
            warm = len(self.replay) >= config.random_steps
            self._act(
                self.imagination,
                self.start_states.sample([config.chunk_steps, config.num_worlds], self.generator),
                noise=config.exploration_noise,
                random_fraction=config.random_fraction if warm else 1.0,
            )
            if warm:
                return
