"""Violations of a task's constraint, as an evaluation reports them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

_PREFIX = "violations/"


@dataclass(frozen=True)
class Violations:
    """Violations of one constraint in episodes that were played.

    In a world whose sensors are noisy, they are those of what was shown.

    Args:
        steps: steps that violated it, int64 ``[episodes]``.
        largest: the largest violation in physical units, ``[episodes]``; 0 where there is none.

    Examples:
        >>> import torch
        >>> found = Violations(torch.tensor([0, 5]), torch.tensor([0.0, 0.25]))
        >>> found.summary("x", lengths=torch.tensor([10, 10]))["violations/x/episodes_share"]
        0.5
    """

    steps: Tensor
    largest: Tensor

    def summary(self, name: str, lengths: Tensor) -> dict[str, float]:
        """Shares of steps and of episodes, and the largest violation, by ``violations/name/...``.

        Args:
            name: name of the constraint.
            lengths: steps of each episode, ``[episodes]``.
        """
        return {
            f"{_PREFIX}{name}/steps_share": (self.steps.sum() / lengths.sum()).item(),
            f"{_PREFIX}{name}/episodes_share": (self.steps > 0).float().mean().item(),
            f"{_PREFIX}{name}/largest": self.largest.max().item(),
        }


def is_violation(key: str) -> bool:
    """Whether a key of a summary is one of these."""
    return key.startswith(_PREFIX)
