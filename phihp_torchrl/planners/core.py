"""The cross-entropy method with a policy as a prior, as a pure function of tensors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.planners.pool import BAD, Plan, Pool, fallback, score_pool, to_pool_layout
from phihp_torchrl.planners.scoring import Problem
from phihp_torchrl.planners.settings import PlanSettings


def plan(
    observation: Any,
    noise: Tensor,
    mean: Tensor | None = None,
    *,
    problem: Problem,
    settings: PlanSettings,
) -> Plan:
    """Plan by the cross-entropy method with a policy as a prior (paper, section 4.3).

    The first iteration's candidates are ``N_pi`` sequences of the actor, rolled out in the model
    with clipped noise (the first without), and ``N_rand`` Gaussian ones; later ones come from a
    Gaussian refitted to the elites. Scores that are not finite never win; where all are bad the
    actor's action is returned, or ``mean`` without an actor. Nothing random happens in here and the
    rows of a batch do not meet, so the same noise gives the same plan, alone or in a batch. It
    compiles as one full graph if the problem's functions do.

    Args:
        observation: where to plan from, ``[*batch, o]``.
        noise: standard normal, ``[I, H, N, *batch, m]`` (:meth:`PlanSettings.noise_shape`).
        mean: center of the first random candidates, and the first of them, ``[*batch, H, m]``.
            Without it the middle of the bounds is the center, and no candidate.
        problem: model, bounds, actor and value.
        settings: the numbers.

    Returns:
        The sequence to act with, and its score.
    """
    s, bounds = settings, problem.bounds
    batch, action_dim = noise.shape[3:-1], noise.shape[-1]
    noise = noise.reshape(*noise.shape[:3], -1, action_dim)
    rows = noise.shape[3]
    state = problem.model.locate(observation)
    state = state.reshape(-1, *state.shape[len(batch) :])

    start = None if mean is None else to_pool_layout(mean, rows)
    center = bounds.center.expand(s.planning_horizon, 1, rows, action_dim)
    center = center if start is None else start
    std = (s.init_std * bounds.scale).expand(center.shape)

    pool = _first_candidates(state, noise[0], center, std, start is not None, problem, s)
    own = pool.first(1)  # the actor's own sequence, if it proposes any
    compare = s.compare_with_actor and s.num_policy_candidates > 0
    rescue = fallback(state, own if s.num_policy_candidates else None, center, problem)
    best = kept = None
    for iteration_noise in noise.unbind(0):
        if best is not None:
            sampled = bounds.clip(center + std * iteration_noise)
            pool = score_pool(state, sampled, problem, s)
            # Who competes again brings its score along, for the model is deterministic.
            rivals = [*([own] if compare else []), *([kept] if kept is not None else [])]
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
            if compare:  # the actor's own sequence, the pool's first, competes again anyway
                again = index[: s.num_kept_elites] == 0
                kept = Pool(kept.actions, kept.scores.masked_fill(again, BAD))
        center, std = _refit(elites, center, std, s.min_std * bounds.scale)
        center = bounds.clip(center)  # where rounding takes a mean of bounds out of them

    assert best is not None  # there is at least one iteration
    chosen = best if s.select == "best" else Pool(center, best.scores)
    if compare:
        if s.select == "mean":
            chosen = score_pool(state, center, problem, s)
        # The actor's wins unless beaten; where neither has a score, the best that had one.
        rival = own.where(own.scores > BAD, best)
        chosen = chosen.where(chosen.scores > own.scores + s.actor_margin, rival)
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
    settings: PlanSettings,
) -> Pool:
    """The actor's sequences, its own first, then the Gaussian's; ``noise`` is ``[H, N, B, m]``."""
    guided, limit = settings.num_policy_candidates, settings.policy_noise_clip
    actions = problem.bounds.clip(center + std * noise)
    if center_competes and guided < settings.num_candidates:
        actions = torch.cat([actions[:, :guided], center, actions[:, guided + 1 :]], 1)
    if not guided:
        return score_pool(state, actions, problem, settings)
    policy_noise = (settings.policy_noise * noise[:, :guided]).clamp(-limit, limit)
    policy_noise = policy_noise * problem.bounds.scale
    policy_noise = torch.cat([torch.zeros_like(center), policy_noise[:, 1:]], 1)
    return score_pool(state, actions, problem, settings, policy_noise)


def _refit(elites: Pool, center: Tensor, std: Tensor, min_std: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and std of the elites, ``[H, 1, B, m]``.

    The best elite stands in for bad ones; where it is bad itself, all stays as it was.
    """
    good = (elites.scores > BAD)[None, ..., None]
    actions = torch.where(good, elites.actions, elites.actions[:, :1])
    variance, mean = torch.var_mean(actions, dim=1, keepdim=True, correction=0)
    new_std = torch.maximum(variance.sqrt(), min_std)
    return torch.where(good[:, :1], mean, center), torch.where(good[:, :1], new_std, std)
