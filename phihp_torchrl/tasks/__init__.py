"""Tasks as data: a system with reward, termination, resets and limits, known by name."""

from __future__ import annotations

from phihp_torchrl.tasks import acrobot, cartpole, pendulum  # noqa: F401  (they register themselves)
from phihp_torchrl.tasks.base import Box, RewardFn, Task, TerminatedFn
from phihp_torchrl.tasks.registry import get_task, list_tasks, register_task

__all__ = ["Box", "RewardFn", "Task", "TerminatedFn", "get_task", "list_tasks", "register_task"]
