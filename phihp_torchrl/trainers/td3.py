"""TD3 on real steps: the paper's model-free baseline, and the policy of its ablations."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.agents import (
    FlatReplay,
    TD3Config,
    act,
    copy_actor,
    copy_twin_qvalue,
    learning_rate_scale,
)
from phihp_torchrl.config import (
    ConfigError,
    check_count,
    check_memory,
    check_not_negative,
    check_share,
)
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Batch, Rollouts, Worlds
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.trainers.td3_base import TD3Trainer
from phihp_torchrl.worlds import make_world


@dataclass(frozen=True)
class RealTD3Config(TD3Config):
    """Settings of TD3 on real steps, in addition to those of :class:`TD3Config`.

    Args:
        real_steps: total number of real transitions.
        batch_size: transitions in an update.
        replay_capacity: transitions kept for replay.
        random_steps: transitions in the replay before the first update; until then actions are
            uniformly random.
        steps_per_update: real steps for each critic update.
        exploration_noise: std of the noise on actions, in units of the action's half-range.
        decay: share of the steps, at the end, over which learning rates fall to a twentieth.
        evaluation_interval: real steps between two evaluations.
        evaluation_episodes: episodes in an evaluation. They are not counted as real steps and do
            not affect the training.
        tau: step τ of the target networks towards the networks, in each update of the actor.
        value_expansion: number of rewards in the value target; 1, because there is no model.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> RealTD3Config(real_steps=1000, random_steps=100).round_steps
        4
    """

    tau: float = 0.01
    real_steps: int = 100_000
    batch_size: int = 128
    replay_capacity: int = 1_000_000
    random_steps: int = 2000
    steps_per_update: int = 2
    exploration_noise: float = 0.1
    decay: float = 0.3
    evaluation_interval: int = 5000
    evaluation_episodes: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count(
            self,
            "real_steps",
            "batch_size",
            "replay_capacity",
            "steps_per_update",
            "evaluation_interval",
            "evaluation_episodes",
        )
        for name in ("batch_size", "replay_capacity"):
            check_memory(self, name, each=16)
        check_not_negative(self, "exploration_noise")
        check_count(self, "random_steps", least=0)
        most = min(self.replay_capacity, self.real_steps)
        if self.random_steps > most:
            raise ConfigError(
                "random_steps",
                f"expected at most {most}, the lesser of replay_capacity and real_steps, "
                f"got {self.random_steps}.",
            )
        check_share(self, "decay")
        if self.value_expansion != 1:
            raise ConfigError(
                "value_expansion",
                f"expected 1, for there is no model to carry on with, got {self.value_expansion}.",
            )
        for name in ("real_steps", "evaluation_interval"):
            if getattr(self, name) % self.round_steps:
                raise ConfigError(
                    name,
                    "expected a multiple of steps_per_update * policy_delay = "
                    f"{self.round_steps}, got {getattr(self, name)}.",
                )

    @property
    def round_steps(self) -> int:
        """Real steps between two rounds of ``policy_delay`` critic updates and one of the actor."""
        return self.steps_per_update * self.policy_delay


class RealTD3Trainer(TD3Trainer):
    """Trains actor and critics by TD3 on real steps, the paper's model-free baseline.

    The world must be simulated; one world is stepped by the function that steps imagined worlds,
    from the task's reset box. Reaching the limit of steps truncates an episode and is not recorded
    as a termination. The result is the last actor, because choosing among actors would need further
    episodes in the real world.

    Args:
        task: the task.
        config: hyper-parameters.
        seed: seed of all random numbers but the initial weights of the networks, which come from
            torch's global generator.
        world: the simulated world, in any form that :func:`~phihp_torchrl.make_world` accepts.
        transitions: real transitions of an earlier phase, with which the replay starts.
        compile: whether to compile the steps of the world and the update.

    Raises:
        ConfigError: for a world that is not simulated.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> config = RealTD3Config(real_steps=40, evaluation_interval=20, random_steps=20)
        >>> trainer = RealTD3Trainer(get_task("pendulum"), config, seed=0)
        >>> while not trainer.done:
        ...     metrics = trainer.advance()
        >>> trainer.real_steps, trainer.updates
        (40, 10)
    """

    def __init__(
        self,
        task: Task,
        config: RealTD3Config,
        *,
        seed: int,
        world: Any = "simulated",
        transitions: Batch | None = None,
        compile: bool = False,
    ) -> None:
        real = make_world(task, world)
        model = real.model()
        if model is None:
            raise ConfigError(
                "world.kind", f"expected a simulated world for this phase, got {real}."
            )
        # Critics learn rewards less the prices of the task; evaluations report the world's.
        priced = TaskWorldModel(task, model.transitions)
        super().__init__(priced, config, seed=seed, compile=compile)
        self.config = config
        self.seconds = 0.0
        self.world = Rollouts(priced, act, task.max_steps, compile=compile)
        self._played = self.world
        if model.task != task:
            self._played = Rollouts(model, act, task.max_steps, compile=compile)
        given = 0 if transitions is None else len(transitions.reward)
        capacity = min(config.replay_capacity, given + config.real_steps)
        self.replay = FlatReplay(capacity, task.state_dim, task.action_dim)
        if transitions is not None:
            self.replay.extend(transitions)
        self.given = given
        first = task.sample_start([1], self.generator)
        self.enter(Worlds(first, torch.zeros(1, dtype=torch.int64)))
        # Evaluations have a generator of their own: the log has no part in the training.
        self._evaluation_states = task.sample_start(
            [config.evaluation_episodes], torch.Generator().manual_seed(seed)
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
        config = self.config
        until = min(self.real_steps + config.evaluation_interval, config.real_steps)
        losses: dict[str, Tensor] = {}
        while self.real_steps < until:
            warm = len(self.replay) >= config.random_steps
            self._act(
                self.world,
                self.task.sample_start([config.round_steps, 1], self.generator),
                noise=config.exploration_noise,
                random_fraction=0.0 if warm else 1.0,
            )
            if warm:
                left = 1.0 - self.real_steps / config.real_steps
                scale = learning_rate_scale(left, config.decay)
                losses = self._learn(config.batch_size, scale)
                self.updates += config.policy_delay
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
        return self._played.returns(self.update.networks.actor, states, steps).total

    def trained(self) -> dict[str, Tensor]:
        """The layers of actor and critics, their targets and moments, by name."""
        groups = self.update.networks._asdict().items()
        return {f"{name}.{i}": layer for name, group in groups for i, layer in enumerate(group)}

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {**super().state_dict(), "seconds": self.seconds}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        super().load_state_dict(state)
        self.seconds = state["seconds"]

    def parts(self) -> dict[str, Any]:
        """Actor and critics, as arguments of :class:`~phihp_torchrl.deployment.Agent`."""
        return {
            "actor": copy_actor(self.task, self.update.actor),
            "qvalue": copy_twin_qvalue(self.task, self.update.critics),
        }


def _build(context: Context) -> Phase:
    config, model = context.config, context.before.get("model")
    return RealTD3Trainer(
        context.task,
        context.settings,
        seed=config.seed,
        world=context.world,
        transitions=None if model is None else model.transitions(),
        compile=context.compile,
    )


register_phase("td3", RealTD3Config, _build, unit="steps", needs_truth=True, needs_env=True)
