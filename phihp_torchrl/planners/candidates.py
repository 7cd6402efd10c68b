"""Candidate action sequences of a plan: their layout, scoring and selection."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.planners.problem import Problem, score_sequences
from phihp_torchrl.planners.search import SearchConfig

# In this module the batch is one dimension, B, after the candidates: sequences are [H, N, B, m], so
# that the actions of one step, and among them those of the actor's candidates, are contiguous rows.
BAD = float("-inf")


class Plan(NamedTuple):
    """The result of planning with CEM.

    Attributes:
        actions: the chosen action sequence, ``[*batch, H, m]``, in bounds.
        score: its score ``[*batch]``; for a mean that was not scored, the score of the best
            candidate; -inf where no candidate had a finite score.
    """

    actions: Tensor
    score: Tensor


class Pool(NamedTuple):
    """Sequences ``[H, N, B, m]`` and their scores ``[N, B]``."""

    actions: Tensor
    scores: Tensor

    def first(self, count: int) -> Pool:
        """Return the first ``count`` sequences."""
        return Pool(self.actions[:, :count], self.scores[:count])

    def best(self, count: int) -> tuple[Pool, Tensor]:
        """Return the ``count`` best sequences of each row, best first, and their indices."""
        scores, index = self.scores.topk(count, dim=0)
        gather_index = index[None, ..., None].expand(
            self.actions.shape[0], -1, -1, self.actions.shape[-1]
        )
        return Pool(self.actions.gather(1, gather_index), scores), index

    def where(self, condition: Tensor, other: Pool) -> Pool:
        """Return these sequences where ``condition`` ``[N, B]`` holds, and those of ``other``."""
        return Pool(
            torch.where(condition[None, ..., None], self.actions, other.actions),
            torch.where(condition, self.scores, other.scores),
        )


def to_pool_layout(sequences: Tensor, rows: int) -> Tensor:
    """Rearrange sequences from ``[*batch, H, m]`` to ``[H, 1, B, m]``."""
    return sequences.reshape(rows, *sequences.shape[-2:]).transpose(0, 1).unsqueeze(1)


def score_pool(
    state: Any,
    actions: Tensor,
    problem: Problem,
    settings: SearchConfig,
    policy_noise: Tensor | None = None,
    last: Tensor | None = None,
    completed: int = 0,
) -> Pool:
    """Score sequences ``[H, N, B, m]`` from states ``[B, n]``.

    Args:
        state: first states.
        actions: the sequences.
        problem: model, bounds, actor and value.
        settings: the settings of the search.
        policy_noise: noise ``[H, N_pi, B, m]`` on the actor's actions, which then replace the first
            ``N_pi`` sequences.
        last: the action before, ``[B, m]``, NaN where there is none.
        completed: number of sequences after these whose last action is the actor's.
    """
    shape = actions.shape
    count = shape[1] * shape[2]
    repeated = state.expand(shape[1], *state.shape).reshape(count, *state.shape[1:])
    scores, actions = score_sequences(
        repeated,
        actions.reshape(shape[0], count, shape[-1]),
        problem,
        gamma=settings.gamma,
        alpha=settings.alpha,
        policy_noise=None if policy_noise is None else policy_noise.flatten(1, 2),
        reduced_tail=settings.tail_dtype == "bfloat16",
        change_cost=settings.change_cost,
        last=None if last is None else last.expand(shape[1], *last.shape).flatten(0, 1),
        completed=completed * shape[2],
    )
    return Pool(actions.view(shape), scores.view(shape[1:3]))


def fallback(state: Any, own: Pool | None, center: Tensor, problem: Problem) -> Tensor:
    """The plan if no score is finite, ``[H, 1, B, m]``: the actor's actions, or the center."""
    if problem.actor is None:
        return center
    if own is not None:
        actions = own.actions
    else:
        action = problem.bounds.clip(problem.actor(problem.model.observe(state)))
        actions = torch.cat([action.expand_as(center[:1]), center[1:]])
    return torch.where(actions.isfinite(), actions, center)
