"""The settings of phase 2, which trains the policy in the model."""

from __future__ import annotations

from dataclasses import dataclass, field

from phihp_torchrl.agents import (
    AnalyticConfig,
    RefitConfig,
    TD3Config,
)
from phihp_torchrl.config import (
    ConfigError,
    Steps,
    check_choice,
    check_count,
    check_fields,
    check_memory,
    check_not_negative,
    check_positive,
    check_share,
    check_steps,
    in_seconds,
)
from phihp_torchrl.imagination import StartConfig
from phihp_torchrl.trainers.learners import LEARNERS

_ROW = 16
"""Numbers of a transition in memory, about."""


@dataclass(frozen=True)
class PolicyConfig:
    """Settings of phase 2, which trains actor and critics in imagination (paper, section 4.2).

    Args:
        method: the way to learn, td3, analytic (gradients through the model, where that is smooth)
            or another registered one.
        updates: planned number of critic updates; patience and extension may change it.
        batch_size: transitions in an update.
        num_worlds: number of imagined worlds that are stepped at once.
        planned: share of them in which plans act, with the present actor and critics, and meet what
            the actor does not find yet; it falls to 0 between a quarter and a half of the updates.
            With method td3 alone.
        chunk_steps: steps of all worlds between two rounds of updates.
        updates_per_step: critic updates for each step of all worlds.
        replay_capacity: imagined transitions kept for replay.
        random_steps: imagined transitions under random actions before the first update.
        exploration_noise: std of the noise on actions, in units of the action's half-range.
        random_fraction: share of actions that are uniformly random.
        max_age: steps after which an imagined episode is truncated, or their duration, such as
            "6 s"; null for the task's limit.
        decay: share of the updates, at the end, over which learning rates fall to a twentieth.
        patience: share of the updates for which the imagined return may stand still before learning
            rates fall and learning ends; 0 for learning to the end.
        tail: share of the updates over which learning rates then fall.
        extension: largest share of the updates that is added, before learning rates fall, while the
            imagined return still rises fast; 0 for none. Nothing is added with patience 0.
        evaluation_interval: updates between two evaluations in the model, which choose the actor to
            keep.
        evaluation_episodes: imagined episodes in an evaluation.
        evaluation_steps: steps in these episodes, or their duration; null for the task's limit.
        real_evaluation_episodes: episodes of the actor in a simulated world at each evaluation,
            which are logged and not used for training; 0 for none.
        max_seconds: duration after which the phase ends early; null for no limit.
        scales: auto to train in units measured from the task's coverage, where observations or
            values are far from the size of one; none to train in physical units.
        draw_constants: whether every imagined world has constants of its own, drawn from the 95 %
            interval that the fit of the model leaves them.
        constants_std: standard deviation that takes the place of the fit's: of a free constant
            relative, of a bounded one of the logit of its place; null for the fit's.
        strategies: what is tried where imagined returns stay at the floor: auto for all strategies
            in turn, none, or a list of names, of goal (starts where the reward is met), analytic
            (gradients through the model), further (longer horizons), wide and backwards (other
            starts).
        start: where imagined episodes start.
        td3: hyper-parameters of TD3; all methods have its networks and γ.
        analytic: hyper-parameters of policy gradients through the model.
        refit: when and how the critics are fitted to the best actor's returns in the model.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> PolicyConfig(random_fraction=1.5)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: random_fraction: expected a number in [0, 1], got 1.5.
    """

    method: str = "td3"
    updates: int = 8000
    batch_size: int = 128
    num_worlds: int = 64
    planned: float = 0.25
    chunk_steps: int = 4
    updates_per_step: int = 8
    replay_capacity: int = 200_000
    random_steps: int = 2048
    exploration_noise: float = 0.1
    random_fraction: float = 0.1
    max_age: Steps | None = None
    decay: float = 0.5
    patience: float = 0.4
    tail: float = 0.15
    extension: float = 1.0
    evaluation_interval: int = 500
    evaluation_episodes: int = 64
    evaluation_steps: Steps | None = None
    real_evaluation_episodes: int = 10
    max_seconds: float | None = None
    scales: str = "auto"
    draw_constants: bool = False
    constants_std: float | None = None
    strategies: str | tuple[str, ...] = "auto"
    start: StartConfig = field(default_factory=StartConfig)
    td3: TD3Config = field(default_factory=TD3Config)
    analytic: AnalyticConfig = field(default_factory=AnalyticConfig)
    refit: RefitConfig = field(default_factory=RefitConfig)

    def __post_init__(self) -> None:
        check_fields(self)
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
        check_memory(self, "num_worlds", "chunk_steps")
        for name in ("batch_size", "replay_capacity", "evaluation_episodes", "random_steps"):
            check_memory(self, name, each=_ROW)
        check_choice(self, "method", LEARNERS)
        check_choice(self, "scales", ("auto", "none"))
        if isinstance(self.strategies, str):
            check_choice(self, "strategies", ("auto", "none"))
        check_share(self, "planned", "random_fraction", "decay", "patience", "tail")
        check_count(self, "random_steps", "real_evaluation_episodes", least=0)
        check_not_negative(self, "exploration_noise", "extension")
        if self.random_steps > self.replay_capacity:
            raise ConfigError(
                "random_steps",
                f"expected at most replay_capacity = {self.replay_capacity}, "
                f"got {self.random_steps}.",
            )
        if self.constants_std is not None and not self.draw_constants:
            raise ConfigError(
                "constants_std",
                f"expected null without draw_constants=true, got {self.constants_std}.",
            )
        for name in ("max_age", "evaluation_steps", "max_seconds", "constants_std"):
            check = check_steps if name in ("max_age", "evaluation_steps") else check_positive
            if getattr(self, name) is not None:
                check(self, name)
        if self.method == "analytic":
            self._check_analytic()
        chunk_updates = self.chunk_steps * self.updates_per_step
        for name, value in (
            ("chunk_steps * updates_per_step", chunk_updates),
            ("evaluation_interval", self.evaluation_interval),
        ):
            if value % self.td3.policy_delay:
                raise ConfigError(
                    name,
                    f"expected a multiple of td3.policy_delay = {self.td3.policy_delay}, "
                    f"got {value}.",
                )
        for name in ("start", "interval") if self.refit.interval and self.refit.start else ():
            value = getattr(self.refit, name)
            if value % self.evaluation_interval:
                raise ConfigError(
                    f"refit.{name}",
                    f"expected a multiple of evaluation_interval = {self.evaluation_interval}, "
                    f"got {value}.",
                )

    def _check_analytic(self) -> None:
        count, horizon = self.analytic.critic_updates, self.analytic.horizon
        numbers = {"updates": self.updates, "evaluation_interval": self.evaluation_interval}
        if not in_seconds(horizon):  # else this is looked at again once they are steps
            numbers["num_worlds * analytic.horizon"] = self.num_worlds * horizon
        for name, value in numbers.items():
            if value % count:
                raise ConfigError(
                    name,
                    f"expected a multiple of analytic.critic_updates = {count} with "
                    f"method=analytic, got {value}.",
                )
