"""TD-MPC on real steps: play an episode with the planner, then learn from replay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from phihp_torchrl.agents import learning_rate_scale
from phihp_torchrl.config import (
    ConfigError,
    Steps,
    check_count,
    check_fields,
    check_memory,
    check_not_negative,
    check_positive,
    check_share,
    check_steps,
    in_seconds,
    resolve_seconds,
)
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.tasks import Task
from phihp_torchrl.tdmpc.agent import TDMPCAgent
from phihp_torchrl.tdmpc.networks import TOLD
from phihp_torchrl.tdmpc.planner import ScheduledMPPIConfig, make_latent_planner
from phihp_torchrl.tdmpc.replay import EpisodeReplay
from phihp_torchrl.tdmpc.update import TDMPCConfig, TDMPCUpdate
from phihp_torchrl.trainers import (
    CollectConfig,
    Context,
    Phase,
    Policy,
    random_policy,
    register_phase,
)
from phihp_torchrl.worlds import check_env, make_world

UNIT_UPDATES = 500
"""Updates in a unit of work, after which a run can be checkpointed."""


@dataclass(frozen=True)
class TDMPCTrainConfig:
    """Settings of the phase in which TD-MPC learns.

    Args:
        real_steps: total number of real transitions.
        seed_steps: real transitions under random actions, before the first update.
        updates_per_step: updates for each real step, made after the episode.
        horizon: transitions in a slice, over which the model is unrolled, or their duration.
        batch_size: slices in an update.
        replay_capacity: transitions kept for replay, including the padding after episodes.
        priority_alpha: exponent α of the priorities; 0 for uniform sampling.
        priority_beta: exponent β of the importance weights.
        decay: share of the updates, at the end, over which learning rates fall to a twentieth.
        evaluation_interval: real steps between two evaluations, which are logged and not used for
            training.
        evaluation_episodes: episodes of the planner without noise, and of the policy, in an
            evaluation; 0 for none.
        learn: networks, losses and learning rates.
        planner: how the agent plans, during training and afterwards.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> TDMPCTrainConfig(horizon=5, replay_capacity=9)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: replay_capacity: expected at least two slices of \
horizon=5, got 9.
    """

    real_steps: int = 30_000
    seed_steps: int = 5000
    updates_per_step: float = 0.5
    horizon: Steps = 5
    batch_size: int = 128
    replay_capacity: int = 1_000_000
    priority_alpha: float = 0.6
    priority_beta: float = 0.4
    decay: float = 0.3
    evaluation_interval: int = 5000
    evaluation_episodes: int = 5
    learn: TDMPCConfig = field(default_factory=TDMPCConfig)
    planner: ScheduledMPPIConfig = field(default_factory=ScheduledMPPIConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        check_steps(self, "horizon")
        check_count(self, "real_steps", "batch_size", "replay_capacity", "evaluation_interval")
        check_memory(self, "horizon", "batch_size", each=16)
        check_memory(self, "replay_capacity", each=16)
        check_count(self, "seed_steps", "evaluation_episodes", least=0)
        check_not_negative(self, "priority_alpha", "priority_beta")
        check_positive(self, "updates_per_step")
        check_share(self, "decay")
        if not in_seconds(self.horizon) and self.replay_capacity < 2 * self.horizon:
            raise ConfigError(
                "replay_capacity",
                f"expected at least two slices of horizon={self.horizon}, "
                f"got {self.replay_capacity}.",
            )


class TDMPCTrainer:
    """Learns latent model, critics and policy from real episodes (Hansen et al., 2022).

    Actions are random for ``seed_steps``, then planned with exploration noise; the planner's
    horizon grows and its noise falls over the real steps. After each planned episode there are
    ``updates_per_step`` updates for each of its steps, and after the random episodes as many for
    all of their steps together.

    Args:
        task: the task.
        config: settings of the phase.
        world: the real world, in any form that :func:`~phihp_torchrl.make_world` accepts. Defaults
            to the simulated world of the task.
        seed: seed of all random numbers but the initial weights of the networks, which come from
            torch's global generator.
        compile: whether to compile losses and gradients.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> config = TDMPCTrainConfig(real_steps=20, seed_steps=10, batch_size=4)
        >>> trainer = TDMPCTrainer(get_task("pendulum"), config, seed=0)
        >>> trainer.advance()["tdmpc/episode_length"]
        20.0
    """

    def __init__(
        self,
        task: Task,
        config: TDMPCTrainConfig,
        *,
        seed: int,
        world: Any = "simulated",
        compile: bool = False,
    ) -> None:
        self.task = task
        self.config = config = resolve_seconds(config, task.time_step)
        self.seed = seed
        self.world = make_world(task, world)
        self.env = self.world.make_env()
        check_env(task, self.env)
        self.generator = torch.Generator().manual_seed(seed)
        self.told = TOLD.for_task(task, config.learn.told)
        self.update = TDMPCUpdate(self.told, config.learn, compile=compile)
        self.replay = EpisodeReplay(
            config.replay_capacity,
            config.horizon,
            config.batch_size,
            alpha=config.priority_alpha,
            beta=config.priority_beta,
            generator=self.generator,
        )
        self.planner = make_latent_planner(
            self.told, config.planner.at(0), generator=self.generator
        )
        self.real_steps = 0
        self.updates_due = 0.0
        self.evaluated = 0

    @property
    def progress(self) -> tuple[int, int]:
        """Real steps learned from so far, and real steps in all."""
        due = int(int(self.updates_due) / self.config.updates_per_step)
        return self.real_steps - due, self.config.real_steps

    @property
    def done(self) -> bool:
        """Whether all real steps are taken and learned from."""
        return (
            self.real_steps >= self.config.real_steps
            and self.updates_due < 1
            and not self._must_evaluate
        )

    @property
    def _must_evaluate(self) -> bool:
        return bool(self.config.evaluation_episodes) and (
            self.real_steps >= self.evaluated + self.config.evaluation_interval
        )

    def advance(self) -> dict[str, float]:
        """Make the updates that are due, or evaluate, or play an episode; returns what to log."""
        if self.updates_due >= 1:
            metrics = self._learn()
        elif self._must_evaluate:
            metrics = self._evaluate()
        else:
            metrics = self._play()
        return {"real_steps": float(self.real_steps), **metrics}

    def agent(self) -> TDMPCAgent:
        """Return the current agent, which shares the networks."""
        return TDMPCAgent(self.task, self.told, self.config.planner.at(self.real_steps))

    def parts(self) -> dict[str, Any]:
        """Return the whole agent, with its planner."""
        return {"agent": self.agent()}

    def trained(self) -> dict[str, Tensor]:
        """The parameters of model, critics and policy, by name."""
        return dict(self.told.named_parameters())

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed run needs, as tensors and numbers."""
        return {
            "update": self.update.state_dict(),
            "replay": self.replay.state_dict(),
            "real_steps": self.real_steps,
            "updates_due": self.updates_due,
            "evaluated": self.evaluated,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.update.load_state_dict(state["update"])
        self.replay.load_state_dict(state["replay"])
        self.real_steps = state["real_steps"]
        self.updates_due = state["updates_due"]
        self.evaluated = state["evaluated"]
        self.generator.set_state(state["generator"])

    def _play(self) -> dict[str, float]:
        """One episode in the real world, cut off where the real steps are used up."""
        config = self.config
        at_random = self.real_steps < config.seed_steps
        if at_random:
            policy = random_policy(self.task, CollectConfig(), self.generator)
        else:
            policy = self._planning_policy()
        # Each episode has its seed, so that a resumed run has the same resets.
        self.env.set_seed(int(torch.randint(2**31, (), generator=self.generator)))
        left = config.real_steps - self.real_steps
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            rollout = self.env.rollout(min(self.task.max_steps, left), policy).detach()
        self.replay.extend(_as_floats(self.task, rollout))
        self.real_steps += len(rollout)
        learned_from = len(rollout)
        if at_random:
            learned_from = self.real_steps if self.real_steps >= config.seed_steps else 0
        self.updates_due += config.updates_per_step * learned_from
        return {
            "tdmpc/episode_return": rollout["next", "reward"].sum().item(),
            "tdmpc/episode_length": float(len(rollout)),
            "tdmpc/planning_horizon": 0.0
            if at_random
            else float(self.planner.settings.planning_horizon),
            "tdmpc/min_std": self.planner.settings.min_std,
        }

    def _planning_policy(self) -> Policy:
        self.planner.settings = self.config.planner.at(self.real_steps)
        self.planner.reset()

        def policy(tensordict: TensorDictBase) -> TensorDictBase:
            latent = self.told.encode(tensordict["observation"].float())
            action = self.planner(TensorDict(latent=latent))["action"]
            return tensordict.set("action", action)

        return policy

    def _learn(self) -> dict[str, float]:
        """The next updates that are due; their mean losses."""
        count = min(int(self.updates_due), UNIT_UPDATES)
        total = self.config.real_steps * self.config.updates_per_step
        sums: dict[str, Tensor] = {}
        for _ in range(count):
            slices = self.replay.sample()
            left = 1.0 - self.update.updates / total
            scale = learning_rate_scale(left, self.config.decay)
            losses = self.update(slices, scale, self.generator)
            self.replay.update_priority(slices, losses["td_error"])
            for name, value in losses.items():
                sums[name] = sums.get(name, torch.zeros(())) + value.mean()
        self.updates_due -= count
        means = {f"tdmpc/{name}": (value / count).item() for name, value in sums.items()}
        return {"tdmpc/updates": float(self.update.updates), **means}

    def _evaluate(self) -> dict[str, float]:
        """The planner without noise, and the policy alone, in the real world."""
        self.evaluated = self.real_steps
        agent, episodes = self.agent(), self.config.evaluation_episodes
        played, alone = (
            evaluate(actor, self.task, episodes=episodes, seed=self.seed, world=self.world)
            for actor in (agent, agent.actor_alone())
        )
        return {
            "return_mean": played.mean,
            "return_std": played.std,
            "tdmpc/policy_return": alone.mean,
        }


def _as_floats(task: Task, rollout: TensorDictBase) -> TensorDict:
    """Return the entries of an episode that replay keeps, in float32; rewards less their prices."""
    following = rollout["next"]
    reward = following["reward"].float()
    before, after = (task.locate(td["observation"].float()) for td in (rollout, following))
    price = task.price(before, rollout["action"].float(), after)
    if price is not None:
        reward = reward - price.unsqueeze(-1)
    return TensorDict(
        observation=rollout["observation"].float(),
        action=rollout["action"].float(),
        next=TensorDict(
            observation=following["observation"].float(),
            reward=reward,
            terminated=following["terminated"],
            batch_size=rollout.batch_size,
        ),
        batch_size=rollout.batch_size,
    )


def _build(context: Context) -> Phase:
    config = context.config
    return TDMPCTrainer(
        context.task,
        context.settings,
        seed=config.seed,
        world=context.world,
        compile=context.compile,
    )


register_phase("tdmpc", TDMPCTrainConfig, _build, unit="steps", needs_env=True)
