"""Environments: the real worlds for gymnasium, and imagination in a learned model."""

from __future__ import annotations

from phihp_torchrl.envs.batched import make_task_env
from phihp_torchrl.envs.latent import LatentEnv
from phihp_torchrl.envs.registration import register_envs
from phihp_torchrl.envs.start_states import (
    BoxStates,
    DataStates,
    MixtureStates,
    StartStates,
    make_start_states,
)
from phihp_torchrl.envs.world_model import WorldModelEnv
from phihp_torchrl.envs.worlds import TaskEnv

__all__ = [
    "BoxStates",
    "DataStates",
    "LatentEnv",
    "MixtureStates",
    "StartStates",
    "TaskEnv",
    "WorldModelEnv",
    "make_start_states",
    "make_task_env",
    "register_envs",
]

register_envs()
