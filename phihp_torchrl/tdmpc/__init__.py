"""TD-MPC (arXiv:2203.04955): a latent model, policy and critics, trained on real episodes."""

from __future__ import annotations

from phihp_torchrl.tdmpc.agent import TDMPCAgent
from phihp_torchrl.tdmpc.equations import Slices
from phihp_torchrl.tdmpc.latent_env import LatentEnv
from phihp_torchrl.tdmpc.loss import TDMPCLoss, TDMPCLossConfig
from phihp_torchrl.tdmpc.networks import TOLD, TOLDConfig
from phihp_torchrl.tdmpc.planner import ScheduledMPPIConfig, make_latent_planner
from phihp_torchrl.tdmpc.replay import EpisodeReplay
from phihp_torchrl.tdmpc.sampler import TensorPrioritizedSliceSampler
from phihp_torchrl.tdmpc.trainer import TDMPCTrainConfig, TDMPCTrainer
from phihp_torchrl.tdmpc.update import TDMPCConfig, TDMPCUpdate

__all__ = [
    "TOLD",
    "TDMPCAgent",
    "TDMPCConfig",
    "TDMPCLoss",
    "TDMPCTrainConfig",
    "TDMPCTrainer",
]
