"""Planners: search in the model, guided by the policy, with Q beyond the horizon (section 4.3)."""

from __future__ import annotations

from phihp_torchrl.planners.candidates import Plan
from phihp_torchrl.planners.cem import FAST_LIMITS, RESTS, CEMConfig, cem_plan
from phihp_torchrl.planners.cem_planner import CEMPlanner
from phihp_torchrl.planners.colored_noise import colored
from phihp_torchrl.planners.mppi import MPPIConfig, MPPINoise, MPPIPlan, mppi_plan
from phihp_torchrl.planners.mppi_planner import MPPIPlanner
from phihp_torchrl.planners.planner_checks import is_finite
from phihp_torchrl.planners.problem import Problem, TensorModel, score_sequences
from phihp_torchrl.planners.registry import PLANNERS, PlannerKind, make_planner, register_planner
from phihp_torchrl.planners.roll_out import LONG_PLAN
from phihp_torchrl.planners.sampling_planner import SamplingPlanner
from phihp_torchrl.planners.search import SearchConfig

__all__ = [
    "CEMConfig",
    "CEMPlanner",
    "MPPIConfig",
    "MPPIPlanner",
    "Problem",
    "SamplingPlanner",
    "SearchConfig",
    "cem_plan",
    "colored",
    "make_planner",
    "mppi_plan",
    "register_planner",
]
