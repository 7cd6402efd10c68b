"""The settings of policy gradients through the model."""

from __future__ import annotations

from dataclasses import dataclass

from phihp_torchrl.config import (
    Steps,
    check_count,
    check_fields,
    check_not_negative,
    check_positive,
    check_positive_share,
    check_share,
    check_steps,
)


@dataclass(frozen=True)
class AnalyticConfig:
    """Hyper-parameters of policy gradients through the model; the networks and γ are TD3's.

    Args:
        horizon: steps of the model through which the gradient of a return goes, or their duration,
            such as "0.8 s"; the critics' value follows.
        trace: λ of the critics' TD(λ) targets.
        noise: std of the noise on the actor's output before its tanh, at first; it falls with the
            learning rates.
        entropy: weight of the entropy of an action, in units of the range of returns, at first; it
            falls with the learning rates and keeps tanh from saturating.
        critic_updates: critic updates for each update of the actor, which share the imagined steps
            between them.
        actor_learning_rate: learning rate of the actor.
        critic_learning_rate: learning rate of the critics.
        tau: step τ of the target critics towards the critics, in each update of the actor.
        step_limit: largest change of a return that an action may claim, for its half-range in one
            step, in units of the range of returns; gradients beyond are scaled down to it.
        norm_limit: largest norm of the actor's gradient, for returns in units of their range.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> AnalyticConfig(horizon=0)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: horizon: expected a whole number >= 1 of steps, or \
seconds such as '1.5 s', got 0.
    """

    horizon: Steps = 16
    trace: float = 0.95
    noise: float = 0.3
    entropy: float = 5e-4
    critic_updates: int = 4
    actor_learning_rate: float = 1e-3
    critic_learning_rate: float = 1e-3
    tau: float = 0.1
    step_limit: float = 1.0
    norm_limit: float = 1.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_steps(self, "horizon")
        check_count(self, "critic_updates")
        check_share(self, "trace")
        check_not_negative(self, "noise", "entropy")
        check_positive(self, "step_limit", "norm_limit")
        check_positive_share(self, "actor_learning_rate", "critic_learning_rate", "tau")
