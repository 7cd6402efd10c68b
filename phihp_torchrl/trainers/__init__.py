"""A trainer for each phase of a method, and the run that goes through the phases."""

from __future__ import annotations

from phihp_torchrl.trainers.calibrate import CalibrateConfig, CalibratePhase
from phihp_torchrl.trainers.collect import CollectConfig, Policy, planning_policy, random_policy
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.evaluate import EvaluateConfig, EvaluatePhase
from phihp_torchrl.trainers.exploration import Exploration, ExplorationConfig
from phihp_torchrl.trainers.floor import Floor
from phihp_torchrl.trainers.imagined_analytic import ImaginedAnalytic
from phihp_torchrl.trainers.imagined_td3 import ImaginedTD3
from phihp_torchrl.trainers.learners import (
    LEARNERS,
    Imagination,
    Learner,
    LearnerKind,
    register_learner,
)
from phihp_torchrl.trainers.loggers import LoggerConfig, RunLogger, make_logger
from phihp_torchrl.trainers.model import ModelTrainer
from phihp_torchrl.trainers.model_config import ModelConfig, make_dynamics
from phihp_torchrl.trainers.phases import PHASES, Phase, PhaseKind, register_phase
from phihp_torchrl.trainers.plugins import import_plugins
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.policy_phase import build_policy
from phihp_torchrl.trainers.policy_search import PolicySearch
from phihp_torchrl.trainers.record import record
from phihp_torchrl.trainers.results import read_controllers, read_result
from phihp_torchrl.trainers.run import RunResult, run
from phihp_torchrl.trainers.run_checks import check_run
from phihp_torchrl.trainers.run_config import RunConfig, task_of
from phihp_torchrl.trainers.run_directory import RunDirectory, new_run_directory, write_atomically
from phihp_torchrl.trainers.run_request import RunRequest, read_request, read_run_config
from phihp_torchrl.trainers.td3 import RealTD3Config, RealTD3Trainer

__all__ = [
    "CalibrateConfig",
    "CalibratePhase",
    "CollectConfig",
    "Context",
    "EvaluateConfig",
    "LoggerConfig",
    "ModelConfig",
    "ModelTrainer",
    "Phase",
    "PolicyConfig",
    "PolicySearch",
    "PolicyTrainer",
    "RealTD3Config",
    "RealTD3Trainer",
    "RunConfig",
    "RunResult",
    "read_run_config",
    "register_learner",
    "register_phase",
    "run",
]
