"""Sequences that compete in a plan: how they are laid out, scored and picked."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.planners.scoring import Problem, score_sequences
from phihp_torchrl.planners.settings import SearchSettings

# In here a batch is one dim, B, and comes after the candidates: sequences are [H, N, B, m], so that
# the actions of a step, and those of the actor's candidates among them, are contiguous rows.
BAD = float("-inf")


class Plan(NamedTuple):
    """What planning returns.

    Attributes:
        actions: the sequence to act with, ``[*batch, H, m]``, in bounds.
        score: its score ``[*batch]``; where a mean was not scored itself, that of the best sequence
            met; -inf where no candidate had a finite score.
    """

    actions: Tensor
    score: Tensor


class Pool(NamedTuple):
    """Sequences ``[H, N, B, m]`` and their scores ``[N, B]``."""

    actions: Tensor
    scores: Tensor

    def first(self, count: int) -> Pool:
        """The first ``count`` of them."""
        return Pool(self.actions[:, :count], self.scores[:count])

    def best(self, count: int) -> tuple[Pool, Tensor]:
        """The ``count`` best of each row, best first, and where they were, ``[count, B]``."""
        scores, index = self.scores.topk(count, dim=0)
        gather_index = index[None, ..., None].expand(
            self.actions.shape[0], -1, -1, self.actions.shape[-1]
        )
        return Pool(self.actions.gather(1, gather_index), scores), index

    def where(self, condition: Tensor, other: Pool) -> Pool:
        """These where ``condition`` ``[N, B]`` holds, else those of ``other``."""
        return Pool(
            torch.where(condition[None, ..., None], self.actions, other.actions),
            torch.where(condition, self.scores, other.scores),
        )


def to_pool_layout(sequences: Tensor, rows: int) -> Tensor:
    """``[*batch, H, m] -> [H, 1, B, m]``."""
    return sequences.reshape(rows, *sequences.shape[-2:]).transpose(0, 1).unsqueeze(1)


def score_pool(
    state: Any,
    actions: Tensor,
    problem: Problem,
    settings: SearchSettings,
    policy_noise: Tensor | None = None,
) -> Pool:
    """Score sequences ``[H, N, B, m]`` from the states ``[B, n]``; the first may be the actor's."""
    shape = actions.shape
    repeated = state.expand(shape[1], *state.shape).reshape(-1, *state.shape[1:])
    scores, actions = score_sequences(
        repeated,
        actions.reshape(shape[0], -1, shape[-1]),
        problem,
        gamma=settings.gamma,
        alpha=settings.alpha,
        policy_noise=None if policy_noise is None else policy_noise.flatten(1, 2),
        reduced_tail=settings.tail_dtype == "bfloat16",
    )
    return Pool(actions.view(shape), scores.view(shape[1:3]))


def fallback(state: Any, own: Pool | None, center: Tensor, problem: Problem) -> Tensor:
    """What to do where every score is bad, ``[H, 1, B, m]``: the actor's, else the center."""
    if problem.actor is None:
        return center
    if own is not None:
        actions = own.actions
    else:
        action = problem.bounds.clip(problem.actor(problem.model.observe(state)))
        actions = torch.cat([action.expand_as(center[:1]), center[1:]])
    return torch.where(actions.isfinite(), actions, center)
