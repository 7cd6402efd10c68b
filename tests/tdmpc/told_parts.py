"""Small networks of TD-MPC, and slices for them."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from phihp_torchrl.tasks import ActionBounds
from phihp_torchrl.tdmpc import TOLD, TOLDConfig

SMALL = TOLDConfig(latent_dim=6, encoder_dim=8, mlp_dim=16)
BOUNDS = ActionBounds.from_limits([-2.0], [2.0])


def make_told(seed=0, terminates=True, bounds=BOUNDS):
    """Small networks without the zeros of the last layers, which would hide gradients."""
    torch.manual_seed(seed)
    told = TOLD(3, bounds, SMALL, terminates=terminates)
    for network in (told.reward, *told.critics):
        torch.nn.init.orthogonal_(network[-1].weight)
    return told


def make_slices(count=4, horizon=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(count, horizon, *shape, generator=generator)

    return TensorDict(
        observation=normal(3),
        action=normal(1),
        valid=torch.ones(count, horizon, dtype=torch.bool),
        next=TensorDict(
            observation=normal(3),
            reward=normal(1),
            terminated=torch.zeros(count, horizon, 1, dtype=torch.bool),
            batch_size=[count, horizon],
        ),
        batch_size=[count, horizon],
    )
