"""A trainer for each phase of a method, and the run that goes through the phases."""

from __future__ import annotations

from phihp_torchrl.trainers.calibrate import CalibrateConfig, CalibratePhase
from phihp_torchrl.trainers.checkpoints import load_latest, load_state
from phihp_torchrl.trainers.collect import CollectConfig, Policy, planning_policy, random_policy
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.evaluate import EvaluateConfig, EvaluatePhase
from phihp_torchrl.trainers.exploration import Exploration, ExplorationConfig
from phihp_torchrl.trainers.files import write_atomically
from phihp_torchrl.trainers.finite import NonFiniteError
from phihp_torchrl.trainers.floor import Floor
from phihp_torchrl.trainers.imagined_analytic import ImaginedAnalytic
from phihp_torchrl.trainers.imagined_play import play
from phihp_torchrl.trainers.imagined_td3 import ImaginedTD3
from phihp_torchrl.trainers.learners import (
    LEARNERS,
    Imagination,
    Learner,
    LearnerKind,
    register_learner,
)
from phihp_torchrl.trainers.loggers import LoggerConfig, RunLogger, make_logger
from phihp_torchrl.trainers.metrics_table import read_rows
from phihp_torchrl.trainers.model import ModelTrainer
from phihp_torchrl.trainers.model_config import ModelConfig, make_dynamics
from phihp_torchrl.trainers.next_steps import next_steps, resume_command
from phihp_torchrl.trainers.phases import PHASES, Phase, PhaseKind, register_phase
from phihp_torchrl.trainers.plateau import Plateau, Schedule
from phihp_torchrl.trainers.plugins import import_plugins
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.policy_phase import build_policy
from phihp_torchrl.trainers.policy_search import PolicySearch
from phihp_torchrl.trainers.record import record
from phihp_torchrl.trainers.rehearsal import rehearse
from phihp_torchrl.trainers.results import read_controllers, read_learned, read_result
from phihp_torchrl.trainers.run import RunResult, run
from phihp_torchrl.trainers.run_checks import check_run
from phihp_torchrl.trainers.run_config import RunConfig, task_of
from phihp_torchrl.trainers.run_directory import RunDirectory, new_run_directory
from phihp_torchrl.trainers.run_request import RunRequest, read_request, read_run_config
from phihp_torchrl.trainers.td3 import RealTD3Config, RealTD3Trainer
from phihp_torchrl.trainers.trust import check_trusted, named_code

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
