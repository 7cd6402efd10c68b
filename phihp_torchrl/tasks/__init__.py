"""Tasks on a system: reward, termination, limits and time step, registered by name."""

from __future__ import annotations

from phihp_torchrl.tasks import acrobot, cartpole, pendulum  # (they register themselves)
from phihp_torchrl.tasks.actuator import Actuator
from phihp_torchrl.tasks.base import Task
from phihp_torchrl.tasks.bounds import ActionBounds
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.constraint import Constraint
from phihp_torchrl.tasks.disturbance import Disturbance, DisturbancePart
from phihp_torchrl.tasks.dry_run import check_functions
from phihp_torchrl.tasks.last_action import LastAction
from phihp_torchrl.tasks.numbers import Numbers
from phihp_torchrl.tasks.registers import Part, Registers
from phihp_torchrl.tasks.registry import find_task, get_task, list_tasks, register_task
from phihp_torchrl.tasks.signal import Signal
from phihp_torchrl.tasks.signal_parts import SignalPart
from phihp_torchrl.tasks.steps import RewardFn, Step, TerminatedFn, Transition
from phihp_torchrl.tasks.trajectories import Trajectories

__all__ = [
    "ActionBounds",
    "Actuator",
    "Box",
    "Constraint",
    "Disturbance",
    "LastAction",
    "Part",
    "Registers",
    "Signal",
    "Task",
    "Trajectories",
    "Transition",
    "get_task",
    "list_tasks",
    "register_task",
]
