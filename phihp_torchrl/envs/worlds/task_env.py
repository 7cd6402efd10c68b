"""The world of any task as a gymnasium environment, stepped by the task's own functions."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from phihp_torchrl.integrators import Integrator, make_integrator
from phihp_torchrl.tasks import Task, get_task


class TaskEnv(gym.Env[Any, Any]):
    """The real world of a task; a subclass adds rendering by inheriting it from gymnasium.

    Observations are ``task.system.observe(state)`` in float32, actions are in physical units and
    clipped to their bounds, the arithmetic is in float64. Episodes end where the task says so;
    ``task.max_steps`` is gymnasium's ``TimeLimit``, applied by ``gymnasium.make``.

    Args:
        task: a :class:`~phihp_torchrl.tasks.Task` or the name of a registered one.
        integrator: how the world integrates, by name; defaults to the task's own integrator.
        render_mode: one of ``metadata["render_modes"]``, or ``None``.

    Raises:
        ValueError: for an unknown task, integrator or render mode; in :meth:`reset`, :meth:`step`
            and on setting :attr:`state`, for a wrong shape, a wrong dtype or non-finite values.

    Examples:
        >>> from phihp_torchrl.envs import TaskEnv
        >>> env = TaskEnv("cartpole", integrator="rk4")
        >>> observation, info = env.reset(options={"state": [0.0, 0.0, 0.1, 0.0]})
        >>> observation.shape, env.state.dtype
        ((5,), dtype('float64'))
    """

    def __init__(
        self,
        task: str | Task,
        *,
        integrator: str | Integrator | None = None,
        render_mode: str | None = None,
    ) -> None:
        super().__init__()  # in a subclass: what gymnasium's environment needs for drawing
        self.task = get_task(task) if isinstance(task, str) else task
        self.integrator = make_integrator(integrator or self.task.integrator)
        modes = [None, *self.metadata["render_modes"]]
        if render_mode not in modes:
            raise ValueError(f"render_mode: expected one of {modes}, got {render_mode!r}.")
        self.render_mode = render_mode
        self.action_space = _action_space(self.task)
        self.observation_space = _observation_space(self.task)
        self.state = None
        self.last_action: NDArray[np.float64] | None = None
        """The last action as it was applied, after clipping; ``None`` before the first step."""

    @property
    def state(self) -> NDArray[np.float64] | None:
        """The physical state ``[n]`` in SPEC's order; ``None`` before the first reset."""
        return self._state

    @state.setter
    def state(self, value: ArrayLike | None) -> None:
        # None comes from the constructors of gymnasium's environments.
        self._state = None if value is None else self._checked_state(value)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode from the task's reset box, or from ``options={"state": ...}``."""
        # Not super(): in a subclass that would be gymnasium's own environment, which draws a state.
        gym.Env.reset(self, seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - {"state"}):
            raise ValueError(f"options: unknown {unknown}, expected at most ['state'].")
        box = self.task.reset
        self.state = options.get("state", self.np_random.uniform(box.low, box.high))
        self.last_action = None
        if self.render_mode == "human":
            self.render()
        return self._observe(torch.from_numpy(self._state)), {}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold ``action`` ``[m]`` for one time step; ``truncated`` is left to ``TimeLimit``."""
        if self._state is None:
            raise ResetNeeded("state: expected a call of reset() before step().")
        held = torch.from_numpy(self._checked_action(action))
        with torch.inference_mode():
            held = self.task.clip_action(held)
            state = torch.from_numpy(self._state)
            next_state = self.task.step(state, held, self.integrator)
            reward = float(self.task.reward(state, held, next_state))
            terminated = bool(self.task.is_terminated(next_state))
            observation = self._observe(next_state)
        self.state = next_state.numpy()
        self.last_action = held.numpy()
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, False, {}

    def _observe(self, state: torch.Tensor) -> NDArray[np.float32]:
        return cast(NDArray[np.float32], self.task.system.observe(state).float().numpy())

    def _checked_state(self, value: ArrayLike) -> NDArray[np.float64]:
        names = self.task.system.state_names
        return _checked("state", value, len(names), f"finite values for {names}")

    def _checked_action(self, value: ArrayLike) -> NDArray[np.float64]:
        high = self.task.action_high
        return _checked("action", value, len(high), f"finite values, bounds ±{high}")


def _checked(what: str, value: ArrayLike, size: int, expected: str) -> NDArray[np.float64]:
    """A float64 copy of ``value`` ``[size]``."""
    array = np.asarray(value)
    if array.shape != (size,) or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError(
            f"{what}: expected shape {(size,)} and {expected}; "
            f"got shape {array.shape}, dtype {array.dtype}, {value!r}."
        )
    return array.astype(np.float64)


def _action_space(task: Task) -> gym.spaces.Box:
    high = np.array(task.action_high, dtype=np.float32)
    return gym.spaces.Box(-high, high, dtype=np.float32)


def _observation_space(task: Task) -> gym.spaces.Box:
    """Cosines and sines within ±1, limited velocities within their limit, all else unbounded."""
    limits = {v: limit for (_, v), limit in zip(task.layout.pairs, task.layout.limits, strict=True)}
    high: list[float] = []
    for i in range(task.system.state_dim):
        high += [1.0, 1.0] if i in task.system.angle_indices else [limits.get(i, np.inf)]
    bound = np.array(high, dtype=np.float32)
    return gym.spaces.Box(-bound, bound, dtype=np.float32)
