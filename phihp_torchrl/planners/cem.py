"""The cross-entropy method guided by a policy: its settings, and a plan as a pure function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from phihp_torchrl.config import (
    ConfigError,
    Steps,
    check_choice,
    check_count,
    check_not_negative,
    check_steps,
    in_seconds,
)
from phihp_torchrl.planners.candidates import (
    BAD,
    Plan,
    Pool,
    fallback,
    score_pool,
    to_pool_layout,
)
from phihp_torchrl.planners.choice import between, prefer
from phihp_torchrl.planners.problem import Problem
from phihp_torchrl.planners.search import SearchConfig
from phihp_torchrl.tasks import ActionBounds

RESTS = 0.02
"""Mean change of the action from step to step, in half-ranges, up to which one rests."""

FAST_LIMITS = {
    "planning_horizon": 3,
    "optim_steps": 2,
    "num_candidates": 32,
    "top_k": 6,
    "num_policy_candidates": 8,
}
"""What a plan has at most on the fast budget (``config/settings/budget/fast.yaml``)."""


@dataclass(frozen=True)
class CEMConfig(SearchConfig):
    """Settings of a :class:`~phihp_torchrl.CEMPlanner` (paper, section 4.3 and its tables).

    Args:
        num_kept_elites: number of elites that are candidates, with their scores, in the next
            iteration too.
        select: whether to act with the refitted mean (mean) or with the best candidate (best).
        compare_with_actor: whether the actor's noise-free sequence is a candidate in every
            iteration, and the planner acts with it unless its plan has a higher score.
        actor_margin: least difference by which the score of the plan must be higher, in units of
            return.
        margin_at_rest: whether that difference is asked for only where the actor's sequence rests:
            where it changes by at most 0.02 of the half-range from step to step, on average.
        keep_incumbent: whether the previous plan, shifted and completed by an action of the actor,
            is a candidate in every iteration and is kept unless another plan has a higher score;
            the mean is then sought between it and the elites' mean. Needs warm_start.
        incumbent_margin: least difference by which the score of another plan must be higher, in
            units of return.
        replan_every: number of actions of a plan that are taken before the next plan, RH, or their
            duration.
        warm_start: whether a plan starts from the previous one, shifted, within an episode.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> CEMConfig(planning_horizon=5).noise_shape((7,), action_dim=1)
        (2, 5, 64, 7, 1)
    """

    kind: ClassVar[str] = "cem"

    num_kept_elites: int = 0
    select: str = "mean"
    compare_with_actor: bool = True
    actor_margin: float = 0.0
    margin_at_rest: bool = False
    keep_incumbent: bool = False
    incumbent_margin: float = 0.0
    replan_every: Steps = 1
    warm_start: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count(self, "num_kept_elites", least=0, most="top_k")
        check_choice(self, "select", ("mean", "best"))
        check_not_negative(self, "actor_margin", "incumbent_margin")
        check_steps(self, "replan_every")
        if not in_seconds(self.replan_every):
            check_count(self, "replan_every", most="planning_horizon")
        for name in ("compare_with_actor", "margin_at_rest", "keep_incumbent", "warm_start"):
            if not isinstance(value := getattr(self, name), bool):
                raise ConfigError(name, f"expected true or false, got {value!r}.")
        if self.keep_incumbent and not self.warm_start:
            raise ConfigError("keep_incumbent", "expected false without warm_start, got true.")
        if self.warm_start and self.num_policy_candidates == self.num_candidates:
            raise ConfigError(
                "warm_start",
                "expected random candidates to start from the previous plan, got "
                f"num_policy_candidates = num_candidates = {self.num_candidates}.",
            )

    def noise_shape(self, batch_size: tuple[int, ...], action_dim: int) -> tuple[int, ...]:
        """Return the shape of the standard normal noise of one plan, ``[I, H, N, *batch, m]``."""
        return (
            self.optim_steps,
            self.planning_horizon,
            self.num_candidates,
            *batch_size,
            action_dim,
        )


def cem_plan(
    observation: Any,
    noise: Tensor,
    mean: Tensor | None = None,
    last: Tensor | None = None,
    *,
    problem: Problem,
    settings: CEMConfig,
) -> Plan:
    """Plan by the cross-entropy method, guided by a policy (paper, section 4.3).

    The candidates of the first iteration are ``N_pi`` sequences of the actor, rolled out in the
    model with clipped noise (the first without noise), and ``N_rand`` Gaussian ones; the candidates
    of later iterations come from a Gaussian that is refitted to the elites. A candidate whose score
    is not finite is never chosen. If no score is finite, the result is the actor's sequence, or
    ``mean`` without an actor. The function draws no random numbers and the rows of a batch are
    independent, so the same noise gives the same plan, alone or in a batch. It compiles as one full
    graph if the functions of ``problem`` do.

    Args:
        observation: observations to plan from, ``[*batch, o]``.
        noise: standard normal noise, ``[I, H, N, *batch, m]`` (:meth:`CEMConfig.noise_shape`).
        mean: center of the first random candidates, and itself one of them, ``[*batch, H, m]``.
            Without it the center is the middle of the bounds, which is not a candidate.
        last: the action before, ``[*batch, m]``, for the price of a change and for
            ``keep_incumbent``. NaN where an episode starts: then the first action has no price, and
            ``mean`` is no plan to be kept.
        problem: model, bounds, actor and value.
        settings: settings of the search.

    Returns:
        The chosen action sequence, and its score.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> settings = CEMConfig(planning_horizon=5, num_policy_candidates=0)
        >>> noise = torch.randn(settings.noise_shape((3,), action_dim=1))
        >>> observation = task.observe(torch.zeros(3, 2))
        >>> problem = Problem(model, task.bounds)
        >>> plan = cem_plan(observation, noise, problem=problem, settings=settings)
        >>> plan.actions.shape, plan.score.shape, bool((plan.actions.abs() <= 2.0).all())
        (torch.Size([3, 5, 1]), torch.Size([3]), True)
    """
    s, bounds = settings, problem.bounds
    batch, action_dim = noise.shape[3:-1], noise.shape[-1]
    rows = batch.numel()
    noise = noise.reshape(*noise.shape[:3], rows, action_dim)
    state = problem.model.locate(observation)
    state = state.reshape(rows, *state.shape[len(batch) :])

    start = None if mean is None else to_pool_layout(mean, rows)
    center = bounds.center.expand(s.planning_horizon, 1, rows, action_dim)
    center = center if start is None else start
    std = (s.init_std * bounds.scale).expand(center.shape)
    last = None if last is None else last.reshape(rows, action_dim)

    guided = s.num_policy_candidates
    keep = s.keep_incumbent and start is not None and last is not None
    pool = _first_candidates(state, noise[0], center, std, start is not None, problem, s, last)
    own = pool.first(1)  # the actor's noise-free sequence, if there are candidates of the actor
    compare = s.compare_with_actor and guided > 0
    rescue = fallback(state, own if guided else None, center, problem)
    standing = [own] if compare else []  # those that compete in every iteration
    if keep:
        incumbent = Pool(pool.actions[:, guided : guided + 1], pool.scores[guided : guided + 1])
        known = last.isfinite().all(-1)  # type: ignore[union-attr]
        incumbent = Pool(incumbent.actions, incumbent.scores.masked_fill(~known, BAD))
        standing.append(incumbent)
    best = kept = None
    for iteration_noise in noise.unbind(0):
        places = [0] if compare else []
        if keep:
            places.append(guided if best is None else len(places))
        if best is not None:
            sampled = bounds.clip(center + std * iteration_noise)
            pool = score_pool(state, sampled, problem, s, last=last)
            # Candidates of earlier iterations keep their scores, since the model is deterministic.
            rivals = [*standing, *([kept] if kept is not None else [])]
            if rivals:
                pool = Pool(
                    torch.cat([*(r.actions for r in rivals), pool.actions], 1),
                    torch.cat([*(r.scores for r in rivals), pool.scores], 0),
                )
        elites, index = pool.best(s.top_k)
        leader = elites.first(1)
        best = leader if best is None else leader.where(leader.scores > best.scores, best)
        if s.num_kept_elites:
            kept = elites.first(s.num_kept_elites)
            for place in places:  # those that compete again anyway
                again = index[: s.num_kept_elites] == place
                kept = Pool(kept.actions, kept.scores.masked_fill(again, BAD))
        center, std = _refit(elites, center, std, s.min_std * bounds.scale)
        center = bounds.clip(center)  # rounding may take a mean of values at a bound out of bounds

    assert best is not None  # there is at least one iteration
    chosen = best if s.select == "best" else Pool(center, best.scores)
    if keep:
        chosen = between(state, center, incumbent.actions, last, problem, s)
        chosen = prefer(best, chosen, 0.0)
        chosen = prefer(chosen, incumbent, s.incumbent_margin)
    elif compare and s.select == "mean":
        chosen = score_pool(state, center, problem, s, last=last)
    if compare:
        # The actor's sequence, unless the plan is better; the best candidate if its score is bad.
        rival = own.where(own.scores > BAD, best)
        asked = _rests(own.actions, bounds) if s.margin_at_rest else 1.0
        chosen = chosen.where(chosen.scores > own.scores + s.actor_margin * asked, rival)
    chosen = chosen.where(best.scores > BAD, Pool(rescue, best.scores))
    actions = chosen.actions[:, 0].transpose(0, 1)
    return Plan(actions.reshape(*batch, *actions.shape[1:]), chosen.scores.reshape(batch))


def _first_candidates(
    state: Any,
    noise: Tensor,
    center: Tensor,
    std: Tensor,
    center_competes: bool,
    problem: Problem,
    settings: CEMConfig,
    last: Tensor | None,
) -> Pool:
    """Score the actor's sequences (noise-free first), then Gaussian ones."""
    guided, limit = settings.num_policy_candidates, settings.policy_noise_clip
    actions = problem.bounds.clip(center + std * noise)
    if center_competes and guided < settings.num_candidates:
        actions = torch.cat([actions[:, :guided], center, actions[:, guided + 1 :]], 1)
    completed = int(settings.keep_incumbent and center_competes)
    if not guided:
        return score_pool(state, actions, problem, settings, None, last, completed)
    policy_noise = (settings.policy_noise * noise[:, :guided]).clamp(-limit, limit)
    policy_noise = policy_noise * problem.bounds.scale
    policy_noise = torch.cat([torch.zeros_like(center), policy_noise[:, 1:]], 1)
    return score_pool(state, actions, problem, settings, policy_noise, last, completed)


def _rests(actions: Tensor, bounds: ActionBounds) -> Tensor:
    """Whether sequences ``[H, N, B, m]`` change next to nothing from step to step, ``[N, B]``."""
    changes = (actions[1:] - actions[:-1]).abs() / bounds.scale
    mean = changes.sum((0, -1)) / (max(len(changes), 1) * actions.shape[-1])
    return mean <= RESTS


def _refit(elites: Pool, center: Tensor, std: Tensor, min_std: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and std of the elites, ``[H, 1, B, m]``.

    The best elite replaces elites without a finite score; if it has none either, mean and std are
    not changed.
    """
    good = (elites.scores > BAD)[None, ..., None]
    actions = torch.where(good, elites.actions, elites.actions[:, :1])
    variance, mean = torch.var_mean(actions, dim=1, keepdim=True, correction=0)
    new_std = torch.maximum(variance.sqrt(), min_std)
    return torch.where(good[:, :1], mean, center), torch.where(good[:, :1], new_std, std)
