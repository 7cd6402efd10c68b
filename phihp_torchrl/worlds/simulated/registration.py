"""Gymnasium ids of simulated worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

from phihp_torchrl.integrators import Integrator
from phihp_torchrl.tasks import Actuator, Task, find_task
from phihp_torchrl.worlds.simulated.env import TaskEnv
from phihp_torchrl.worlds.simulated.plant import Plant
from phihp_torchrl.worlds.simulated.rendering import env_class


def register_env(id: str, task: Task) -> None:
    """Register a gymnasium id for the simulated world of a registered task.

    The paper's tasks have ids already. A task without an id can be made by
    ``gymnasium.make("phihp/Task-v0", task=task_or_name)``. If the id is taken, nothing is done.

    Args:
        id: the id, such as ``"my-lab/Crane-v0"``.
        task: a registered task.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> register_env("my-lab/Pendulum-v0", get_task("pendulum"))
        >>> gym.make("my-lab/Pendulum-v0", integrator="rk4").action_space
        Box(-2.0, 2.0, (1,), float32)
    """
    if id not in gym.registry:
        gym.register(
            id,
            entry_point="phihp_torchrl.worlds:make_task_env",
            max_episode_steps=task.max_steps,
            kwargs={"task": task.name},
        )


def make_task_env(task: str | Task, **options: Any) -> TaskEnv:
    """Make the simulated world of a task, with pictures if its system is one of the paper's.

    Args:
        task: a task or the name of a registered one.
        options: ``integrator``, ``plant``, ``actuator``, ``noise`` and
            ``render_mode`` of
            :class:`~phihp_torchrl.worlds.TaskEnv`.

    Examples:
        >>> type(make_task_env("pendulum-swingup")).__name__
        'PendulumEnv'
    """
    task = find_task(task)
    return env_class(task.system)(task, **options)


def make_limited_env(
    task: str | Task,
    *,
    integrator: str | Integrator | None = None,
    plant: Plant | None = None,
    actuator: Actuator | None = None,
    noise: Mapping[str, float] | None = None,
    render_mode: str | None = None,
) -> gym.Env[Any, Any]:
    """Make the simulated world of a task, truncated after ``max_steps``, for ``phihp/Task-v0``.

    Args:
        task: a task or the name of a registered one.
        integrator: name of the integrator, or an instance.
        plant: true constants and friction.
        actuator: what happens to a command before it acts. Defaults to the task's.
        noise: standard deviation of what the sensors show, by name of the state.
        render_mode: ``"human"`` or ``"rgb_array"`` if the task's system is one of the paper's.

    Examples:
        >>> import phihp_torchrl
        >>> gym.make("phihp/Task-v0", task="pendulum-swingup").unwrapped.task.name
        'pendulum-swingup'
    """
    task = find_task(task)
    options = {"integrator": integrator, "plant": plant, "actuator": actuator, "noise": noise}
    env = make_task_env(task, **options, render_mode=render_mode)
    return TimeLimit(env, max_episode_steps=task.max_steps)
