"""A trainer for each phase, and the run that carries them through."""

from __future__ import annotations

from phihp_torchrl.trainers.collect import CollectConfig
from phihp_torchrl.trainers.config import ConfigError, from_mapping, to_mapping
from phihp_torchrl.trainers.loggers import LoggerConfig, RunLogger, make_logger
from phihp_torchrl.trainers.methods import METHODS, Method, get_method, register_method
from phihp_torchrl.trainers.model import ModelConfig, ModelTrainer, make_dynamics
from phihp_torchrl.trainers.phases import read_result
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig, StartConfig
from phihp_torchrl.trainers.run import RunResult, run
from phihp_torchrl.trainers.run_config import (
    EvaluateConfig,
    RunConfig,
    RunRequest,
    import_plugins,
    read_request,
)
from phihp_torchrl.trainers.show import show_episode
from phihp_torchrl.trainers.td3 import RealTD3Config, RealTD3Trainer
from phihp_torchrl.trainers.tdmpc import TDMPCTrainConfig, TDMPCTrainer

__all__ = [
    "METHODS",
    "CollectConfig",
    "ConfigError",
    "EvaluateConfig",
    "LoggerConfig",
    "Method",
    "ModelConfig",
    "ModelTrainer",
    "PolicyConfig",
    "PolicyTrainer",
    "RealTD3Config",
    "RealTD3Trainer",
    "RunConfig",
    "RunLogger",
    "RunRequest",
    "RunResult",
    "StartConfig",
    "TDMPCTrainConfig",
    "TDMPCTrainer",
    "from_mapping",
    "get_method",
    "import_plugins",
    "make_dynamics",
    "make_logger",
    "read_request",
    "read_result",
    "register_method",
    "run",
    "show_episode",
    "to_mapping",
]
