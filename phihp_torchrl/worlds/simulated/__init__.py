"""Simulated worlds: plants (true constants and friction), gymnasium environments, pictures."""

from __future__ import annotations

from phihp_torchrl.worlds.simulated import plants  # (they register themselves)
from phihp_torchrl.worlds.simulated.env import TaskEnv
from phihp_torchrl.worlds.simulated.plant import Plant, PlantPhysics, find_plant, register_plant
from phihp_torchrl.worlds.simulated.registration import (
    make_limited_env,
    make_task_env,
    register_env,
)
from phihp_torchrl.worlds.simulated.world import SimulatedConfig, SimulatedWorld

__all__ = [
    "Plant",
    "SimulatedConfig",
    "SimulatedWorld",
    "TaskEnv",
    "register_env",
    "register_plant",
]
