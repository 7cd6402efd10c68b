"""Two policies compared over the same episodes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class PairedDifference(NamedTuple):
    """Mean of paired differences and its standard error."""

    mean: float
    standard_error: float

    @property
    def is_worse(self) -> bool:
        """Whether the first is below the second by more than two standard errors."""
        return self.mean < -2.0 * self.standard_error


def paired_difference(returns_a: Tensor, returns_b: Tensor) -> PairedDifference:
    """``a - b`` for episodes that were paired by their seed.

    Args:
        returns_a: returns ``[episodes]``.
        returns_b: returns of the same episodes.

    Raises:
        ValueError: for shapes that differ or fewer than two episodes.

    Examples:
        >>> paired_difference(torch.tensor([2.0, 4.0]), torch.tensor([1.0, 1.0]))
        PairedDifference(mean=2.0, standard_error=1.0)
    """
    if returns_a.shape != returns_b.shape or returns_a.ndim != 1 or len(returns_a) < 2:
        raise ValueError(
            "returns_a, returns_b: expected the same two or more episodes, got shapes "
            f"{list(returns_a.shape)} and {list(returns_b.shape)}."
        )
    difference = returns_a.to(torch.float64) - returns_b.to(torch.float64)
    error = difference.std() / math.sqrt(len(difference))
    return PairedDifference(difference.mean().item(), error.item())
