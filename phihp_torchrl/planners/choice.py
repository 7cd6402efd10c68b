"""Which of the sequences of a plan wins: the search's, the previous plan's or the actor's."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.planners.candidates import BAD, Pool, score_pool
from phihp_torchrl.planners.problem import Problem
from phihp_torchrl.planners.search import SearchConfig

# How far the mean of the elites may lie from the previous plan. The mean of few elites is a noisy
# estimate of the best sequence, and the score tells how much of its difference is worth having.
_SHARES = (1.0, 0.5, 0.25)


def between(
    state: Any,
    center: Tensor,
    anchor: Tensor,
    last: Tensor | None,
    problem: Problem,
    settings: SearchConfig,
) -> Pool:
    """Return the best sequence on the way from ``anchor`` to ``center``, ``[H, 1, B, m]`` each."""
    anchor = torch.where(anchor.isfinite(), anchor, center)
    steps = [anchor + share * (center - anchor) for share in _SHARES]
    pool = score_pool(state, torch.cat(steps, 1), problem, settings, last=last)
    return pool.best(1)[0]


def prefer(pool: Pool, rival: Pool, margin: float) -> Pool:
    """Return ``rival`` unless ``pool`` has a score that is higher by more than ``margin``.

    Args:
        pool: one sequence for each row, ``[H, 1, B, m]``.
        rival: another, which a tie goes to.
        margin: in units of return.
    """
    return rival.where((rival.scores > BAD) & (rival.scores + margin >= pool.scores), pool)
