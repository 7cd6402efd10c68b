"""PhIHP in TorchRL: a physics-informed model, a policy learned in imagination, hybrid planning.

Importing this package registers the gymnasium ids of the paper's tasks and costs next to nothing:
each name below is imported with its folder when it is first used, and torch with it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from phihp_torchrl.commands import Learned, learn
    from phihp_torchrl.config import ConfigError, load_config, register_method
    from phihp_torchrl.deployment import Agent, load_agent, save_agent
    from phihp_torchrl.dynamics import DynamicsLoss, HybridDynamics, TaskWorldModel
    from phihp_torchrl.evaluation import evaluate
    from phihp_torchrl.imagination import WorldModelEnv
    from phihp_torchrl.planners import CEMPlanner, MPPIPlanner, register_planner
    from phihp_torchrl.systems import Constant, LagrangianSystem, System
    from phihp_torchrl.tasks import Box, Constraint, Signal, Task, get_task, register_task
    from phihp_torchrl.trainers import RunConfig, RunResult, register_phase, run
    from phihp_torchrl.worlds import Plant, World, make_world, register_plant, register_world

__version__ = "0.3.0"

_HOMES = {
    "commands": ("Learned", "learn"),
    "config": ("ConfigError", "load_config", "register_method"),
    "deployment": ("Agent", "load_agent", "save_agent"),
    "dynamics": ("DynamicsLoss", "HybridDynamics", "TaskWorldModel"),
    "evaluation": ("evaluate",),
    "imagination": ("WorldModelEnv",),
    "planners": ("CEMPlanner", "MPPIPlanner", "register_planner"),
    "systems": ("Constant", "LagrangianSystem", "System"),
    "tasks": (
        "Actuator",
        "Box",
        "Constraint",
        "Disturbance",
        "Signal",
        "Task",
        "Trajectories",
        "get_task",
        "register_task",
    ),
    "trainers": ("RunConfig", "RunResult", "register_phase", "run"),
    "worlds": ("Plant", "World", "make_world", "register_plant", "register_world"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Actuator",
    "Agent",
    "Box",
    "CEMPlanner",
    "ConfigError",
    "Constant",
    "Constraint",
    "Disturbance",
    "DynamicsLoss",
    "HybridDynamics",
    "LagrangianSystem",
    "Learned",
    "MPPIPlanner",
    "Plant",
    "RunConfig",
    "RunResult",
    "Signal",
    "System",
    "Task",
    "TaskWorldModel",
    "Trajectories",
    "World",
    "WorldModelEnv",
    "evaluate",
    "get_task",
    "learn",
    "load_agent",
    "load_config",
    "make_world",
    "register_method",
    "register_phase",
    "register_planner",
    "register_plant",
    "register_task",
    "register_world",
    "run",
    "save_agent",
]

_ENV_IDS = {
    "phihp/Pendulum-v0": ("pendulum", 200),
    "phihp/PendulumSwingup-v0": ("pendulum-swingup", 500),
    "phihp/CartPole-v0": ("cartpole", 500),
    "phihp/CartPoleSwingup-v0": ("cartpole-swingup", 500),
    "phihp/CartPoleSwingupPublished-v0": ("cartpole-swingup-published", 500),
    "phihp/Acrobot-v0": ("acrobot", 500),
    "phihp/AcrobotSwingup-v0": ("acrobot-swingup", 500),
}
# These repeat names and step limits of the tasks, because importing the tasks imports torch. A test
# checks that the two agree.

for _id, (_task, _steps) in _ENV_IDS.items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="phihp_torchrl.worlds:make_task_env",
            max_episode_steps=_steps,
            kwargs={"task": _task},
        )
if "phihp/Task-v0" not in gymnasium.registry:
    gymnasium.register("phihp/Task-v0", entry_point="phihp_torchrl.worlds:make_limited_env")


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
