"""What phase 2, TD3 in imagination, is told: budgets, batches, and where imagined lives start."""

from __future__ import annotations

from dataclasses import dataclass, field

from phihp_torchrl.agents import RefitConfig, TD3Config
from phihp_torchrl.ranges import check_count, check_not_negative, check_share


@dataclass(frozen=True)
class StartConfig:
    """Where imagined lives start: shares of each source.

    :func:`~phihp_torchrl.envs.make_start_states` says what the sources are.
    """

    reset: float = 0.2
    data: float = 0.0
    coverage: float = 0.6
    goal: float = 0.2


@dataclass(frozen=True)
class PolicyConfig:
    """Phase 2.

    Args:
        updates: critic updates in all.
        batch_size: transitions in an update.
        num_worlds: imagined worlds.
        chunk_steps: steps of all worlds between two rounds of updates.
        updates_per_step: critic updates for each step of all worlds.
        replay_capacity: transitions kept.
        random_steps: imagined transitions under random actions before the first update.
        exploration_noise: std of the noise on actions, in units of the action bounds.
        random_fraction: share of actions that are uniformly random.
        max_age: steps after which an imagined life is truncated; ``None`` for the task's own limit.
        decay: the share of the updates, at the end, over which learning rates fall to a twentieth.
        evaluation_interval: updates between two evaluations in the model.
        evaluation_episodes: imagined episodes in an evaluation.
        evaluation_steps: their length; ``None`` for the task's own limit.
        real_evaluation_episodes: episodes of the actor in the simulated real world at each
            evaluation, for the log alone; 0 for none.
        max_seconds: stop early after this time; ``None`` for never.
        start: where imagined lives start.
        td3: TD3's own hyper-parameters.
        refit: when and how the critics are fitted to the best actor's returns in the model.
    """

    updates: int = 8000
    batch_size: int = 128
    num_worlds: int = 64
    chunk_steps: int = 4
    updates_per_step: int = 8
    replay_capacity: int = 1_000_000
    random_steps: int = 2048
    exploration_noise: float = 0.1
    random_fraction: float = 0.1
    max_age: int | None = None
    decay: float = 0.5
    evaluation_interval: int = 500
    evaluation_episodes: int = 64
    evaluation_steps: int | None = None
    real_evaluation_episodes: int = 10
    max_seconds: float | None = None
    start: StartConfig = field(default_factory=StartConfig)
    td3: TD3Config = field(default_factory=TD3Config)
    refit: RefitConfig = field(default_factory=RefitConfig)

    def __post_init__(self) -> None:
        check_count(
            self,
            "updates",
            "batch_size",
            "num_worlds",
            "chunk_steps",
            "updates_per_step",
            "replay_capacity",
            "evaluation_interval",
            "evaluation_episodes",
        )
        check_share(self, "random_fraction", "decay")
        check_not_negative(self, "random_steps", "exploration_noise", "real_evaluation_episodes")
        for name in ("max_age", "evaluation_steps", "max_seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected a positive number or none, got {value}.")
        chunk_updates = self.chunk_steps * self.updates_per_step
        for name, value in (
            ("chunk_steps * updates_per_step", chunk_updates),
            ("evaluation_interval", self.evaluation_interval),
        ):
            if value % self.td3.policy_delay:
                raise ValueError(
                    f"{name}: expected a multiple of td3.policy_delay = {self.td3.policy_delay}, "
                    f"got {value}."
                )
        for name in ("start", "interval"):
            value = getattr(self.refit, name)
            if value % self.evaluation_interval:
                raise ValueError(
                    f"refit.{name}: expected a multiple of evaluation_interval = "
                    f"{self.evaluation_interval}, got {value}."
                )
