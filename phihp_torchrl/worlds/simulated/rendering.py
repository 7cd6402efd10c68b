"""Simulated worlds of the paper's systems, with the pictures of gymnasium's classic control.

Each class inherits ``render`` and ``close`` from gymnasium's environment and everything else from
:class:`TaskEnv`; it only adds the attributes that gymnasium's ``render`` reads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.envs import classic_control

from phihp_torchrl.systems import Acrobot, CartPole, Pendulum, System
from phihp_torchrl.tasks import Task
from phihp_torchrl.worlds.simulated.env import TaskEnv


class PendulumEnv(TaskEnv, classic_control.PendulumEnv):  # type: ignore[misc]  # a property for `state`
    """A :class:`TaskEnv` of a :class:`~phihp_torchrl.systems.Pendulum`, drawn by gymnasium."""

    @property
    def last_u(self) -> float | None:
        """The torque that the picture's arrow shows."""
        return None if self.last_action is None else float(self.last_action[0])


class CartPoleEnv(TaskEnv, classic_control.CartPoleEnv):
    """A :class:`TaskEnv` of a :class:`~phihp_torchrl.systems.CartPole`, drawn by gymnasium."""

    def __init__(self, task: str | Task, **options: Any) -> None:
        super().__init__(task, **options)
        self.length = self.plant.constants["half_length"]
        if self.task.coverage is not None:
            # The picture's half width. A swing-up needs more than gymnasium's 2.4 m, which would
            # also cut off the tip of a hanging pole.
            self.x_threshold = self.task.coverage.high[0]

    def render(self) -> Any:
        # The cart may be hundreds of metres away, where pygame cannot draw.
        state = self._state
        if state is not None:
            far = 2.0 * self.x_threshold
            self._state = np.array([np.clip(state[0], -far, far), *state[1:]])
        try:
            return super().render()
        finally:
            self._state = state


class AcrobotEnv(TaskEnv, classic_control.AcrobotEnv):  # type: ignore[misc]  # a property for `state`
    """A :class:`TaskEnv` of an :class:`~phihp_torchrl.systems.Acrobot`, drawn by gymnasium."""


_DRAWN: dict[type[System], type[TaskEnv]] = {
    Pendulum: PendulumEnv,
    CartPole: CartPoleEnv,
    Acrobot: AcrobotEnv,
}


def env_class(system: System) -> type[TaskEnv]:
    """Return the class that can draw ``system``, or :class:`TaskEnv` if there is none."""
    for kind, env in _DRAWN.items():
        if isinstance(system, kind):
            return env
    return TaskEnv
