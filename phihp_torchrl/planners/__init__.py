"""Acting: cross-entropy planning in the model, the policy as a prior and Q beyond the horizon."""

from __future__ import annotations

from phihp_torchrl.planners.cem import CEMPlanner
from phihp_torchrl.planners.core import Plan, plan
from phihp_torchrl.planners.scoring import ActionBounds, Problem, TensorModel, score_sequences
from phihp_torchrl.planners.settings import PlanSettings

__all__ = [
    "ActionBounds",
    "CEMPlanner",
    "Plan",
    "PlanSettings",
    "Problem",
    "TensorModel",
    "plan",
    "score_sequences",
]
