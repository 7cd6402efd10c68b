"""Batches of transitions, and steps of a model that are safe against non-finite numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

Transit = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""``state, action -> next_state, reward, terminated`` (see ``TaskWorldModel.transition``)."""


class Batch(NamedTuple):
    """A batch of transitions, as replay buffers and TD3 use them.

    Examples:
        >>> rows = torch.zeros(4, 2), torch.zeros(4, 1), torch.ones(4), torch.zeros(4, 2)
        >>> batch = Batch(*rows, terminated=torch.zeros(4, dtype=torch.bool))
        >>> batch.reward.sum(), batch.next_state.shape
        (tensor(4.), torch.Size([4, 2]))
    """

    state: Tensor
    """States before the step, ``[N, n]``."""
    action: Tensor
    """Actions in physical units, ``[N, m]``."""
    reward: Tensor
    """Rewards, ``[N]``."""
    next_state: Tensor
    """States after the step, ``[N, n]``."""
    terminated: Tensor
    """Whether the step ended the episode, bool ``[N]``; truncations do not count."""


def finite_transition(
    transition: Transit, state: Tensor, action: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Take a step of the model; where it gives non-finite numbers, terminate without moving.

    The reward of such a step is 0.
    """
    next_state, reward, terminated = transition(state, action)
    finite = next_state.isfinite().all(-1) & reward.isfinite()
    next_state = torch.where(finite.unsqueeze(-1), next_state, state)
    return next_state, torch.where(finite, reward, torch.zeros_like(reward)), terminated | ~finite
