"""PhIHP in TorchRL: a physics-informed model, a policy learned in imagination, hybrid planning."""

from __future__ import annotations

from phihp_torchrl.deployment import load_agent
from phihp_torchrl.dynamics import DynamicsLoss, HybridDynamics
from phihp_torchrl.envs import WorldModelEnv  # (importing envs registers the gymnasium ids)
from phihp_torchrl.planners import CEMPlanner
from phihp_torchrl.tasks import Task, get_task, register_task

__all__ = [
    "CEMPlanner",
    "DynamicsLoss",
    "HybridDynamics",
    "Task",
    "WorldModelEnv",
    "get_task",
    "load_agent",
    "register_task",
]
__version__ = "0.1.0"
