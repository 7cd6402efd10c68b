"""Settings that all planners share which sample action sequences and refit a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from phihp_torchrl.config import (
    Discount,
    Steps,
    check_choice,
    check_count,
    check_discount,
    check_not_negative,
    check_positive,
    check_steps,
)


@dataclass(frozen=True)
class SearchConfig:
    """Settings of a search that samples action sequences and refits a Gaussian to the best.

    Standard deviations and clips are in units of the action's half-range, so that 1 is the distance
    from the middle to a bound. For an action without bounds they are in physical units. The letters
    are those of the paper, section 4.3 and its tables.

    Args:
        planning_horizon: actions in a plan, H, or its duration, such as "0.4 s".
        optim_steps: iterations of sampling, scoring and refitting, I.
        num_candidates: candidates in an iteration, N = N_π + N_rand.
        top_k: number of elites, to which the Gaussian is refitted, K.
        num_policy_candidates: number of candidates from the actor, N_π. The first of them has no
            noise.
        policy_noise: std of the noise on the actor's other candidates, in units of the action's
            half-range.
        policy_noise_clip: largest absolute value of that noise, in the same units.
        alpha: weight α of the value beyond the horizon.
        gamma: discount γ of rewards, also without Q, or its time constant, such as "5 s".
        init_std: std of the random candidates in the first iteration, in units of the action's
            half-range.
        min_std: lower limit of the refitted std, in the same units.
        noise_beta: exponent β of the spectrum of the noise along the horizon: 0 for white noise, 1
            for pink, 2 for that of a random walk; more is smoother.
        change_cost: price of a change of the action from one step to the next, in units of reward
            for a change by the half-range, squared. It is part of the score of every sequence.
        tail_dtype: precision of actor and Q beyond the horizon, float32 or bfloat16 (faster,
            accurate to about three digits; the last layer of this package's critics stays in
            float32).

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> SearchConfig(num_candidates=8, top_k=9)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: top_k: expected at most num_candidates = 8, got 9.
    """

    kind: ClassVar[str]

    planning_horizon: Steps = 10
    optim_steps: int = 2
    num_candidates: int = 64
    top_k: int = 6
    num_policy_candidates: int = 20
    policy_noise: float = 0.2
    policy_noise_clip: float = 0.6
    alpha: float = 1.0
    gamma: Discount = 0.99
    init_std: float = 1.0
    min_std: float = 0.0
    noise_beta: float = 0.0
    change_cost: float = 0.0
    tail_dtype: str = "float32"

    def __post_init__(self) -> None:
        for field in fields(self):  # numbers of NumPy, and tensors of one number
            value = getattr(self, field.name)
            if not isinstance(value, (str, bool, int, float)) and hasattr(value, "item"):
                object.__setattr__(self, field.name, value.item())
        check_steps(self, "planning_horizon")
        check_count(self, "optim_steps", "num_candidates")
        check_count(self, "top_k", most="num_candidates")
        check_count(self, "num_policy_candidates", least=0, most="num_candidates")
        check_not_negative(self, "policy_noise", "policy_noise_clip", "min_std", "alpha")
        check_not_negative(self, "noise_beta", "change_cost")
        check_positive(self, "init_std")
        check_discount(self, "gamma", least_open=False)
        check_choice(self, "tail_dtype", ("float32", "bfloat16"))
