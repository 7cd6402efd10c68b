"""The worlds of the six tasks: our physics, with the pictures of gymnasium's classic control.

Each class inherits ``render`` and ``close`` from gymnasium's environment and everything else from
:class:`TaskEnv`; it only provides what those pictures read.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv, PendulumEnv
from gymnasium.wrappers import TimeLimit

from phihp_torchrl.envs.worlds.task_env import TaskEnv
from phihp_torchrl.integrators import Integrator
from phihp_torchrl.systems import Acrobot, CartPole, Pendulum, System
from phihp_torchrl.tasks import Task, get_task


class PendulumWorld(TaskEnv, PendulumEnv):  # type: ignore[misc]  # a property for `state`
    """A :class:`TaskEnv` of a :class:`~phihp_torchrl.systems.Pendulum`, drawn by gymnasium."""

    @property
    def last_u(self) -> float | None:
        """The torque that the picture's arrow shows."""
        return None if self.last_action is None else float(self.last_action[0])


class CartPoleWorld(TaskEnv, CartPoleEnv):
    """A :class:`TaskEnv` of a :class:`~phihp_torchrl.systems.CartPole`, drawn by gymnasium."""

    def __init__(self, task: str | Task, **options: Any) -> None:
        super().__init__(task, **options)
        self.length = self.task.system.constants["half_length"]
        if self.task.coverage is not None:
            # The picture's half width. A swing-up needs more than gymnasium's 2.4 m, which would
            # also cut off the tip of a hanging pole.
            self.x_threshold = self.task.coverage.high[0]

    def render(self) -> Any:
        # A cart pushed one way drives hundreds of metres off, and pygame can not draw there.
        state = self._state
        if state is not None:
            far = 2.0 * self.x_threshold
            self._state = np.array([np.clip(state[0], -far, far), *state[1:]])
        try:
            return super().render()
        finally:
            self._state = state


class AcrobotWorld(TaskEnv, AcrobotEnv):  # type: ignore[misc]  # a property for `state`
    """A :class:`TaskEnv` of an :class:`~phihp_torchrl.systems.Acrobot`, drawn by gymnasium."""


_WORLDS: dict[type[System], type[TaskEnv]] = {
    Pendulum: PendulumWorld,
    CartPole: CartPoleWorld,
    Acrobot: AcrobotWorld,
}


def world_class(system: System) -> type[TaskEnv]:
    """The world that can draw ``system``; plain :class:`TaskEnv` for a system of the user's."""
    for kind, world in _WORLDS.items():
        if isinstance(system, kind):
            return world
    return TaskEnv


def make_world(
    task: str | Task,
    *,
    integrator: str | Integrator | None = None,
    render_mode: str | None = None,
) -> gym.Env[Any, Any]:
    """The world of any task, truncated after ``task.max_steps``: entry point of ``phihp/Task-v0``.

    Args:
        task: a task or the name of a registered one.
        integrator: how the world integrates; defaults to the task's own integrator.
        render_mode: ``"human"`` or ``"rgb_array"`` if the task's system is one of ours.

    Examples:
        >>> import gymnasium as gym, phihp_torchrl
        >>> env = gym.make("phihp/Task-v0", task="pendulum-swingup")
        >>> type(env.unwrapped).__name__
        'PendulumWorld'
    """
    task = get_task(task) if isinstance(task, str) else task
    world = world_class(task.system)
    return TimeLimit(
        world(task, integrator=integrator, render_mode=render_mode),
        max_episode_steps=task.max_steps,
    )
