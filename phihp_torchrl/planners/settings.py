"""How a plan is made, as data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlanSettings:
    """The numbers of a cross-entropy plan (paper, section 4.3 and its table of hyper-parameters).

    Names are those of :class:`~phihp_torchrl.CEMPlanner`, which documents them for users. Standard
    deviations and clips are in units of the action's half-range, so 1 reaches from the middle to a
    bound.

    Args:
        planning_horizon: actions in a sequence, ``H``.
        optim_steps: iterations of sampling, scoring and refitting, ``I``.
        num_candidates: sequences sampled in each iteration, those of the actor included,
            ``N = N_pi + N_rand``.
        top_k: elites that the Gaussian is refitted to, ``K``.
        num_policy_candidates: how many of the first iteration's candidates the actor proposes,
            ``N_pi``. The first of them is the actor's own sequence, without noise.
        policy_noise: std of the noise on the others.
        policy_noise_clip: bound on that noise.
        alpha: weight of the value beyond the horizon.
        gamma: discount.
        num_kept_elites: elites that compete again, with the score they have, in the next iteration.
        init_std: std of the first iteration's random candidates.
        min_std: floor of the refitted std.
        select: ``"mean"`` acts with the refitted mean, ``"best"`` with the best sequence met.
        compare_with_actor: whether the actor's own sequence competes in every iteration, and is
            returned unless the plan scores higher. Needs ``num_policy_candidates >= 1``.
        actor_margin: by how much the plan must beat the actor's own sequence, in units of return.

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
    num_kept_elites: int = 0
    init_std: float = 1.0
    min_std: float = 0.0
    select: str = "mean"
    compare_with_actor: bool = True
    actor_margin: float = 0.0

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
        _check_count("num_kept_elites", self.num_kept_elites, 0, self.top_k, "top_k")
        for name in ("policy_noise", "policy_noise_clip", "min_std", "alpha", "actor_margin"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(
                    f"{name}: expected a finite number >= 0, got {getattr(self, name)!r}."
                )
        if not 0 < self.init_std < float("inf"):
            raise ValueError(f"init_std: expected a finite number > 0, got {self.init_std!r}.")
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma: expected a number in [0, 1], got {self.gamma!r}.")
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


def _check_count(
    name: str, value: object, low: int, high: int | None, high_name: str | None = None
) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ValueError(f"{name}: expected an integer >= {low}, got {value!r}.")
    if high is not None and value > high:
        raise ValueError(f"{name}: expected at most {high_name}={high}, got {value}.")
