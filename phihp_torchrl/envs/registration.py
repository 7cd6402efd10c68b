"""Gymnasium ids of the worlds."""

from __future__ import annotations

import gymnasium as gym

from phihp_torchrl.envs.worlds import make_world, world_class
from phihp_torchrl.tasks import get_task, list_tasks

TASK_ENV_ID = "phihp/Task-v0"
"""The id that serves any task: ``gymnasium.make("phihp/Task-v0", task=task_or_name)``."""


def register_envs() -> None:
    """Register with gymnasium each registered task that has an ``env_id``, and ``phihp/Task-v0``.

    Importing :mod:`phihp_torchrl` calls it; call it again after registering a task of your own with
    an ``env_id``. An id that gymnasium knows already is left alone, so a task derived from another
    by ``dataclasses.replace`` wants an ``env_id`` of its own, or ``None``.

    Examples:
        >>> import gymnasium as gym, phihp_torchrl
        >>> gym.make("phihp/Acrobot-v0", integrator="rk4").action_space
        Box(-1.0, 1.0, (1,), float32)
    """
    if TASK_ENV_ID not in gym.registry:
        gym.register(TASK_ENV_ID, entry_point=_path(make_world))
    for name in list_tasks():
        task = get_task(name)
        if task.env_id is not None and task.env_id not in gym.registry:
            gym.register(
                task.env_id,
                entry_point=_path(world_class(task.system)),
                max_episode_steps=task.max_steps,
                kwargs={"task": name},
            )


def _path(creator: object) -> str:
    """``module:name``: a text, so that the spec can be written to JSON."""
    return f"{creator.__module__}:{creator.__qualname__}"  # type: ignore[attr-defined]
