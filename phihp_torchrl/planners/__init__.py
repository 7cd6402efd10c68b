"""Acting: planning in the model, the policy as a prior and Q beyond the horizon."""

from __future__ import annotations

from phihp_torchrl.planners.cem import CEMPlanner
from phihp_torchrl.planners.core import plan
from phihp_torchrl.planners.mppi import MPPIPlanner
from phihp_torchrl.planners.mppi_core import MPPINoise, MPPIPlan, mppi_plan
from phihp_torchrl.planners.pool import Plan
from phihp_torchrl.planners.scoring import ActionBounds, Problem, TensorModel, score_sequences
from phihp_torchrl.planners.settings import MPPISettings, PlanSettings, SearchSettings

__all__ = [
    "ActionBounds",
    "CEMPlanner",
    "MPPINoise",
    "MPPIPlan",
    "MPPIPlanner",
    "MPPISettings",
    "Plan",
    "PlanSettings",
    "Problem",
    "SearchSettings",
    "TensorModel",
    "mppi_plan",
    "plan",
    "score_sequences",
]
