"""How a plan is made, as data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchSettings:
    """What every planner that samples and refits has: the numbers of its search.

    Standard deviations and clips are in units of the action's half-range, so 1 reaches from the
    middle to a bound.

    Args:
        planning_horizon: actions in a sequence, ``H``.
        optim_steps: iterations of sampling, scoring and refitting, ``I``.
        num_candidates: sequences that compete, those of the actor included,
            ``N = N_pi + N_rand``.
        top_k: elites that the Gaussian is refitted to, ``K``.
        num_policy_candidates: how many of the first iteration's candidates the actor proposes,
            ``N_pi``. The first of them is the actor's own sequence, without noise.
        policy_noise: std of the noise on the others.
        policy_noise_clip: bound on that noise.
        alpha: weight of the value beyond the horizon.
        gamma: discount.
        init_std: std of the first iteration's random candidates.
        min_std: floor of the refitted std.
        tail_dtype: ``"float32"``, or ``"bfloat16"`` to evaluate actor and critics beyond the
            horizon under autocast, faster and to about three digits.

    Raises:
        ValueError: for a value out of range, by the name of its argument.
    """

    planning_horizon: int
    optim_steps: int
    num_candidates: int
    top_k: int
    num_policy_candidates: int = 0
    policy_noise: float = 0.05
    policy_noise_clip: float = 0.3
    alpha: float = 1.0
    gamma: float = 0.99
    init_std: float = 1.0
    min_std: float = 0.0
    tail_dtype: str = "float32"

    def __post_init__(self) -> None:
        for name in ("planning_horizon", "optim_steps", "num_candidates", "top_k"):
            _check_count(name, getattr(self, name), 1, None)
        _check_count("top_k", self.top_k, 1, self.num_candidates, "num_candidates")
        _check_count(
            "num_policy_candidates",
            self.num_policy_candidates,
            0,
            self.num_candidates,
            "num_candidates",
        )
        for name in ("policy_noise", "policy_noise_clip", "min_std", "alpha"):
            _check_not_negative(name, getattr(self, name))
        if not 0 < self.init_std < float("inf"):
            raise ValueError(f"init_std: expected a finite number > 0, got {self.init_std!r}.")
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma: expected a number in [0, 1], got {self.gamma!r}.")
        if self.tail_dtype not in ("float32", "bfloat16"):
            raise ValueError(
                f"tail_dtype: expected 'float32' or 'bfloat16', got {self.tail_dtype!r}."
            )


@dataclass(frozen=True)
class PlanSettings(SearchSettings):
    """The numbers of a cross-entropy plan (paper, section 4.3 and its table of hyper-parameters).

    Names are those of :class:`~phihp_torchrl.CEMPlanner`, which documents them for users; those of
    every search are in :class:`SearchSettings`.

    Args:
        num_kept_elites: elites that compete again, with the score they have, in the next iteration.
        select: ``"mean"`` acts with the refitted mean, ``"best"`` with the best sequence met.
        compare_with_actor: whether the actor's own sequence competes in every iteration, and is
            returned unless the plan scores higher. Needs ``num_policy_candidates >= 1``.
        actor_margin: by how much the plan must beat the actor's own sequence, in units of return.

    Raises:
        ValueError: for a value out of range, by the name of its argument.
    """

    num_kept_elites: int = 0
    select: str = "mean"
    compare_with_actor: bool = True
    actor_margin: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_count("num_kept_elites", self.num_kept_elites, 0, self.top_k, "top_k")
        _check_not_negative("actor_margin", self.actor_margin)
        if self.select not in ("mean", "best"):
            raise ValueError(f"select: expected 'mean' or 'best', got {self.select!r}.")

    def noise_shape(self, batch_size: tuple[int, ...], action_dim: int) -> tuple[int, ...]:
        """Shape of the standard normal noise of one plan: ``[I, H, N, *batch, m]``."""
        return (
            self.optim_steps,
            self.planning_horizon,
            self.num_candidates,
            *batch_size,
            action_dim,
        )


@dataclass(frozen=True)
class MPPISettings(SearchSettings):
    """The numbers of a plan by model-predictive path integral control, as TD-MPC makes it.

    Those of every search are in :class:`SearchSettings`; the defaults here are the published ones
    (Hansen et al., 2022, arXiv:2203.04955, appendix). The actor's ``num_policy_candidates`` compete
    in every iteration, beside ``num_candidates - num_policy_candidates`` new ones.

    Args:
        temperature: how much a better score weighs: elites count in proportion to
            ``exp(temperature * score)``.
        momentum: share of the old mean in the new one.
        select: ``"sample"`` acts with an elite drawn by its weight, ``"mean"`` with the mean.

    Raises:
        ValueError: for a value out of range, by the name of its argument.
    """

    planning_horizon: int = 5
    optim_steps: int = 6
    num_candidates: int = 537
    top_k: int = 64
    num_policy_candidates: int = 25
    init_std: float = 2.0
    min_std: float = 0.05
    temperature: float = 0.5
    momentum: float = 0.1
    select: str = "sample"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_policy_candidates == self.num_candidates:
            raise ValueError(
                "num_policy_candidates: expected fewer than "
                f"num_candidates={self.num_candidates}, got {self.num_policy_candidates}."
            )
        if self.min_std > self.init_std:
            raise ValueError(
                f"min_std: expected at most init_std={self.init_std}, got {self.min_std}."
            )
        _check_not_negative("temperature", self.temperature)
        if not 0 <= self.momentum < 1:
            raise ValueError(f"momentum: expected a number in [0, 1), got {self.momentum!r}.")
        if self.select not in ("sample", "mean"):
            raise ValueError(f"select: expected 'sample' or 'mean', got {self.select!r}.")


def _check_not_negative(name: str, value: float) -> None:
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name}: expected a finite number >= 0, got {value!r}.")


def _check_count(
    name: str, value: object, low: int, high: int | None, high_name: str | None = None
) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ValueError(f"{name}: expected an integer >= {low}, got {value!r}.")
    if high is not None and value > high:
        raise ValueError(f"{name}: expected at most {high_name}={high}, got {value}.")
