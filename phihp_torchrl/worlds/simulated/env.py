"""The simulated world of any task as a gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import Integrator, make_integrator
from phihp_torchrl.tasks import Actuator, Task, find_task
from phihp_torchrl.worlds.simulated.plant import Plant, find_plant


class TaskEnv(gym.Env[Any, Any]):
    """The simulated world of a task as a gymnasium environment.

    Observations are those of the system, in float32, without what is under way in an actuator.
    Behind them are the task's references and inputs with their previews, as :meth:`Task.observe`
    has them; ``info`` has their present values by name. Actions are in physical units and brought
    within their bounds and rate, the arithmetic is in float64. Rewards are those of the task,
    without prices. Episodes end where the task terminates them; ``gymnasium.make`` applies
    ``task.max_steps`` by a ``TimeLimit``. Subclasses for the paper's systems inherit rendering from
    gymnasium's environments.

    Args:
        task: a :class:`~phihp_torchrl.tasks.Task` or the name of a registered one.
        integrator: name of the integrator, or an instance. Defaults to semi-implicit Euler.
        plant: true constants and friction. Defaults to the plant registered for the task's system.
        actuator: what happens to a command before it acts. Defaults to the task's.
        noise: standard deviation of what the sensors show, by name of the state; the world itself
            moves without noise. Defaults to none.
        render_mode: one of ``metadata["render_modes"]``, or ``None``.

    Raises:
        ValueError: for an unknown task, integrator or render mode; in :meth:`reset`, :meth:`step`
            and on setting :attr:`state`, for a wrong shape, a wrong dtype or non-finite values.

    Examples:
        >>> from phihp_torchrl.worlds import TaskEnv
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
        plant: Plant | None = None,
        actuator: Actuator | None = None,
        noise: Mapping[str, float] | None = None,
        render_mode: str | None = None,
    ) -> None:
        super().__init__()  # in a subclass: what gymnasium's environment needs for drawing
        self.task = find_task(task).unpriced()
        if actuator is not None:
            self.task = replace(self.task, actuator=actuator)
        self.plant = plant or find_plant(self.task.system)
        self.integrator = make_integrator(integrator or "semi_implicit_euler")
        self.layout = self.task.layout.coupled(self.plant.impulse)
        self.noise = _sensor_noise(self.task, noise or {})
        modes = [None, *self.metadata["render_modes"]]
        if render_mode not in modes:
            raise ValueError(f"render_mode: expected one of {modes}, got {render_mode!r}.")
        self.render_mode = render_mode
        self.action_space = _action_space(self.task)
        self.observation_space = _observation_space(self.task)
        self.state = None
        self.last_action: NDArray[np.float64] | None = None
        """What acted in the last step, after clipping; ``None`` before the first step."""

    @property
    def state(self) -> NDArray[np.float64] | None:
        """The physical state ``[n]``, in the system's order; ``None`` before the first reset."""
        return self._state

    @state.setter
    def state(self, value: ArrayLike | None) -> None:
        # None comes from the constructors of gymnasium's environments.
        self._state = None if value is None else self._checked_state(value)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode from the task's reset box, or from ``options={"state": ...}``.

        References and inputs are drawn by the task's samplers, or taken from ``options``:
        ``options={"reference": ...}`` is a value ``[k]`` that stays, or a trajectory ``[T, k]``
        from the first step on, whose last value stays.
        """
        # Not super(): in a subclass that would be gymnasium's own environment, which draws a state.
        gym.Env.reset(self, seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - (known := {"state", *self.task.outside.signals})):
            raise ValueError(f"options: unknown {unknown}, expected at most {sorted(known)}.")
        box = self.task.reset
        self.state = options.get("state", self.np_random.uniform(box.low, box.high))
        state = self.task.at_rest(torch.from_numpy(self._state))
        self._registers = self.task.split(state)[1]
        self._start_signals(options)
        self.last_action = None
        if self.render_mode == "human":
            self.render()
        return self._observe(torch.from_numpy(self._state)), self._info()

    def _start_signals(self, options: dict[str, Any]) -> None:
        """Draw the references and inputs of an episode, or take those of the caller."""
        self._time, outside = 0, self.task.outside
        if not outside:
            return
        generator = torch.Generator().manual_seed(int(self.np_random.integers(2**31)))
        drawn = outside.draw([], self.task.max_steps + 1, generator)
        for name, signal in outside.signals.items():
            if options.get(name) is not None:
                given = torch.as_tensor(np.asarray(options[name], dtype=np.float64))
                drawn[name] = _as_trajectory(name, given, signal.size)
        self._trajectory = drawn
        self._registers = outside.replaced(self._registers, outside.window(drawn, 0))

    def _info(self) -> dict[str, Any]:
        """The present references and inputs by their keys, float64 ``[k]``."""
        return {k: v.numpy() for k, v in self.task.outside.values(self._registers).items()}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold ``action`` ``[m]`` for one time step; ``truncated`` is left to ``TimeLimit``."""
        if self._state is None:
            raise ResetNeeded("state: expected a call of reset() before step().")
        wanted = torch.from_numpy(self._checked_action(action))
        with torch.inference_mode():
            state = torch.cat([torch.from_numpy(self._state), self._registers])
            next_state, reward, terminated = self.task.transition(self._move, state, wanted)
            moved, self._registers = self.task.split(next_state)
            if outside := self.task.outside:
                self._time += 1
                window = outside.window(self._trajectory, self._time)
                self._registers = outside.replaced(self._registers, window)
            observation = self._observe(moved)
        self.state = moved.numpy()
        if self.render_mode == "human":
            self.render()
        return observation, float(reward), bool(terminated), False, self._info()

    def _move(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        self.last_action = action[: self.task.action_dim].numpy()
        return self.integrator(
            lambda s: self.plant.derivative(s, action), state, self.task.time_step, self.layout
        )

    def _observe(self, state: torch.Tensor) -> NDArray[np.float32]:
        if self.noise.any():
            drawn = self.np_random.standard_normal(len(self.noise))
            state = state + torch.from_numpy(self.noise * drawn)
        shown = self.task.system.observe(state)
        if self.task.outside:
            shown = self.task.complete(shown, self._registers)[: self.task.shown_dim]
        return cast(NDArray[np.float32], shown.float().numpy())

    def _checked_state(self, value: ArrayLike) -> NDArray[np.float64]:
        names = self.task.system.state_names
        return _checked("state", value, len(names), f"finite values for {names}")

    def _checked_action(self, value: ArrayLike) -> NDArray[np.float64]:
        low, high = self.task.action_low, self.task.action_high
        return _checked("action", value, len(high), f"finite values, bounds {low} to {high}")


def _sensor_noise(task: Task, noise: Mapping[str, float]) -> NDArray[np.float64]:
    """Standard deviations ``[n]`` in the order of the states."""
    names = task.system.state_names
    if unknown := sorted(set(noise) - set(names)):
        raise ConfigError("noise", f"unknown {unknown}, expected some of {list(names)}.")
    for name, value in noise.items():
        if not 0 <= value < np.inf:
            raise ConfigError(f"noise.{name}", f"expected a number of at least 0, got {value}.")
    return np.array([noise.get(name, 0.0) for name in names], dtype=np.float64)


def _checked(what: str, value: ArrayLike, size: int, expected: str) -> NDArray[np.float64]:
    """A float64 copy of ``value`` ``[size]``."""
    array = np.asarray(value)
    if array.shape != (size,) or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError(
            f"{what}: expected shape {(size,)} and {expected}; "
            f"got shape {array.shape}, dtype {array.dtype}, {value!r}."
        )
    return array.astype(np.float64)


def _as_trajectory(name: str, given: torch.Tensor, size: int) -> torch.Tensor:
    """A trajectory ``[T, k]`` from one that a caller gives, or from a value ``[k]`` that stays."""
    rows = given.reshape(1, -1) if given.ndim == 1 else given
    if rows.ndim != 2 or rows.shape[-1] != size or not len(rows) or not rows.isfinite().all():
        raise ValueError(
            f"options.{name}: expected finite values of shape [{size}] or [T, {size}], "
            f"got shape {list(given.shape)}: {given.tolist()}."
        )
    return rows


def _action_space(task: Task) -> gym.spaces.Box:
    low, high = (np.array(limit, dtype=np.float32) for limit in (task.action_low, task.action_high))
    return gym.spaces.Box(low, high, dtype=np.float32)


def _observation_space(task: Task) -> gym.spaces.Box:
    """Cosines and sines within ±1, limited velocities within their limits, all else unbounded."""
    limits = {v: limit for (_, v), limit in zip(task.layout.pairs, task.layout.limits, strict=True)}
    bounds: list[tuple[float, float]] = []
    for i in range(task.system.state_dim):
        free = limits.get(i, (-np.inf, np.inf))
        bounds += [(-1.0, 1.0)] * 2 if i in task.system.angle_indices else [free]
    bounds += [(-np.inf, np.inf)] * task.outside.size  # a caller may give any
    low, high = np.array(bounds, dtype=np.float32).T
    return gym.spaces.Box(low, high, dtype=np.float32)
