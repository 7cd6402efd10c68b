"""PhIHP as TorchRL components: a physics-informed model, a policy learned in imagination, hybrid planning."""

from __future__ import annotations

import phihp_torchrl.envs  # noqa: F401  (registers the gymnasium ids)
from phihp_torchrl.dynamics import HybridDynamics
from phihp_torchrl.tasks import Task, get_task, register_task

__all__ = ["HybridDynamics", "Task", "get_task", "register_task"]
__version__ = "0.1.0"
