"""The hybrid model F^p + F^r: as a transition, its loss, its fit, and as a TorchRL world model."""

from __future__ import annotations

from phihp_torchrl.dynamics.actuator_choice import (
    ActuatorTrial,
    choose_actuator,
    explained_by_commands,
)
from phihp_torchrl.dynamics.covariance import constants_covariance, draw_shifts
from phihp_torchrl.dynamics.ensemble import EnsembleResidual
from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.fitting import FitReport, fit
from phihp_torchrl.dynamics.held_out import (
    BLOCK,
    rollout_error,
    split,
    successive_correlation,
)
from phihp_torchrl.dynamics.hybrid import PRIORS, RESIDUAL_OUTPUTS, HybridDynamics
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.per_life import per_life
from phihp_torchrl.dynamics.prepared import PreparedModel
from phihp_torchrl.dynamics.prior import PhysicsPrior, perturbed_constants
from phihp_torchrl.dynamics.ranks import signed_rank
from phihp_torchrl.dynamics.residual import ACTIVATIONS, ResidualMLP
from phihp_torchrl.dynamics.restarts import fit_from_other_weights
from phihp_torchrl.dynamics.solver_choice import AUTO, SOLVERS, fit_solver
from phihp_torchrl.dynamics.under_way import with_registers
from phihp_torchrl.dynamics.world_model import TaskWorldModel

__all__ = [
    "DynamicsLoss",
    "EnsembleResidual",
    "FitConfig",
    "HybridDynamics",
    "PhysicsPrior",
    "ResidualMLP",
    "TaskWorldModel",
    "constants_covariance",
    "draw_shifts",
    "fit",
    "fit_solver",
    "per_life",
]
