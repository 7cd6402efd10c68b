"""Worlds, the source of real steps: simulated, gymnasium's, TorchRL's, or recordings."""

from __future__ import annotations

from phihp_torchrl.worlds.agreement import disagreements
from phihp_torchrl.worlds.base import World
from phihp_torchrl.worlds.command_memory import command_memory
from phihp_torchrl.worlds.guards import (
    GuardedWorld,
    crossings_text,
    guard_env,
    read_guards,
)
from phihp_torchrl.worlds.gymnasium import GymnasiumConfig, GymnasiumWorld
from phihp_torchrl.worlds.recorded import RecordedConfig, RecordedWorld
from phihp_torchrl.worlds.registry import (
    WORLDS,
    GivenConfig,
    WorldKind,
    has_env,
    make_world,
    register_world,
)
from phihp_torchrl.worlds.simulated import (
    Plant,
    PlantPhysics,
    SimulatedConfig,
    SimulatedWorld,
    TaskEnv,
    find_plant,
    make_limited_env,
    make_task_env,
    register_env,
    register_plant,
)
from phihp_torchrl.worlds.task_check import check_env, check_task
from phihp_torchrl.worlds.torchrl import EnvWorld, TorchRLConfig, import_object

__all__ = [
    "EnvWorld",
    "GymnasiumConfig",
    "GymnasiumWorld",
    "Plant",
    "RecordedConfig",
    "RecordedWorld",
    "SimulatedConfig",
    "SimulatedWorld",
    "TaskEnv",
    "TorchRLConfig",
    "World",
    "check_task",
    "make_world",
    "register_env",
    "register_plant",
    "register_world",
]
