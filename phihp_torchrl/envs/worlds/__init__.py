"""The real worlds, friction included, as gymnasium environments."""

from __future__ import annotations

from phihp_torchrl.envs.worlds.classic_control import (
    AcrobotWorld,
    CartPoleWorld,
    PendulumWorld,
    make_world,
    world_class,
)
from phihp_torchrl.envs.worlds.task_env import TaskEnv

__all__ = [
    "AcrobotWorld",
    "CartPoleWorld",
    "PendulumWorld",
    "TaskEnv",
    "make_world",
    "world_class",
]
