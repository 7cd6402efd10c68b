"""TD-MPC: a latent model, its policy and critics, learned together from real episodes."""

from __future__ import annotations

from phihp_torchrl.agents.tdmpc.loss import TDMPCLoss, TDMPCLossConfig
from phihp_torchrl.agents.tdmpc.losses import Slices
from phihp_torchrl.agents.tdmpc.priorities import TensorPrioritizedSliceSampler
from phihp_torchrl.agents.tdmpc.replay import EpisodeReplay
from phihp_torchrl.agents.tdmpc.told import TOLD, TOLDConfig
from phihp_torchrl.agents.tdmpc.update import TDMPCConfig, TDMPCUpdate

__all__ = [
    "TOLD",
    "EpisodeReplay",
    "Slices",
    "TDMPCConfig",
    "TDMPCLoss",
    "TDMPCLossConfig",
    "TDMPCUpdate",
    "TOLDConfig",
    "TensorPrioritizedSliceSampler",
]
