"""The model: F^p + F^r as a transition, its loss, and its shape as a TorchRL world model."""

from __future__ import annotations

from phihp_torchrl.dynamics.fitting import FitConfig, FitReport, fit
from phihp_torchrl.dynamics.held_out import BLOCK, rollout_error, split
from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.prior import PhysicsPrior, WorldPhysics, perturbed_constants
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.dynamics.world_model import TaskWorldModel

__all__ = [
    "BLOCK",
    "DynamicsLoss",
    "FitConfig",
    "FitReport",
    "HybridDynamics",
    "PhysicsPrior",
    "ResidualMLP",
    "TaskWorldModel",
    "WorldPhysics",
    "fit",
    "perturbed_constants",
    "rollout_error",
    "split",
]
