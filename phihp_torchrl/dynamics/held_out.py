"""Held-out real data, and the error of the model's rollouts on them."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.dynamics.loss import DynamicsLoss

BLOCK = 20
"""Steps in a block; one block in ten is held out."""


def split(data: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase, TensorDictBase | None]:
    """Hold out every tenth block of :data:`BLOCK` consecutive steps.

    Args:
        data: transitions ``[N]`` in chronological order.

    Returns:
        The transitions to learn from, the held-out transitions, and the held-out blocks in which no
        episode ended, ``[blocks, steps]``, or ``None`` if there are none.
    """
    index = torch.arange(len(data))
    held = (index // BLOCK) % 10 == 9
    if not held.any():  # too few transitions for a held-out block
        held = index % 10 == 9 if len(data) >= 10 else index == len(data) - 1
        return data[~held] if len(data) > 1 else data, data[held], None
    blocks = data[: len(data) // BLOCK * BLOCK].reshape(-1, BLOCK)[9::10]
    whole = ~blocks["next", "done"][:, :-1].any(-1).any(-1)
    blocks = blocks[whole]
    return data[~held], data[held], blocks if len(blocks) else None


@torch.no_grad()
def rollout_error(loss: DynamicsLoss, blocks: TensorDictBase) -> Tensor:
    """Mean distance ‖s - ŝ‖ after the last step of each block ``[blocks, steps]``, raw units."""
    state, action, next_state = loss.transitions(blocks)
    predicted = loss.dynamics.rollout(state[:, 0], action, loss.time_step(blocks))[:, -1]
    return loss.dynamics.task.difference(next_state[:, -1], predicted).norm(dim=-1).mean()
