"""What a task adds to a system: reward, termination, resets, limits and time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phihp_torchrl.integrators import Integrator, StateLayout, make_integrator
from phihp_torchrl.systems import System

RewardFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""``state [*batch, n], action [*batch, m], next_state [*batch, n] -> reward [*batch]``."""
TerminatedFn = Callable[[Tensor], Tensor]
"""``next_state [*batch, n] -> bool [*batch]``."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box of states, sampled uniformly.

    Args:
        low: lower corner, one number per state component.
        high: upper corner.

    Examples:
        >>> Box(low=(-1.0, 0.0), high=(1.0, 0.0)).sample([5]).shape
        torch.Size([5, 2])
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.low) != len(self.high):
            raise ValueError(f"low, high: expected equal lengths, got {self.low}, {self.high}.")
        pairs = zip(self.low, self.high, strict=True)
        if any(not -math.inf < low <= high < math.inf for low, high in pairs):
            raise ValueError(
                f"low, high: expected finite low <= high, got {self.low}, {self.high}."
            )

    @classmethod
    def around(cls, center: tuple[float, ...], radius: tuple[float, ...]) -> Box:
        """The box ``center ± radius``."""
        if len(center) != len(radius):
            raise ValueError(f"center, radius: expected equal lengths, got {center}, {radius}.")
        pairs = list(zip(center, radius, strict=True))
        return cls(tuple(c - r for c, r in pairs), tuple(c + r for c, r in pairs))

    def sample(
        self,
        shape: torch.Size | list[int],
        *,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw states ``[*shape, n]``."""
        low = torch.tensor(self.low, dtype=dtype, device=device)
        high = torch.tensor(self.high, dtype=dtype, device=device)
        noise = torch.rand([*shape, len(self.low)], generator=generator, dtype=dtype, device=device)
        return low + (high - low) * noise


@dataclass(frozen=True)
class Task:
    """A control task on a :class:`~phihp_torchrl.systems.System`, as data; SPEC's are built so.

    Args:
        name: what recipes call it, e.g. ``"pendulum-swingup"``.
        system: the physics, with the world's true constants and friction.
        action_high: bound on each ``|action|`` component, in physical units.
        time_step: seconds an action is held.
        max_steps: steps after which an episode is truncated (never terminated).
        reset: where episodes start.
        reward: reward of a transition, a pure function of tensors.
        terminated: whether the next state ends the episode; ``None`` if none does.
        velocity_limits: bound on ``|velocity|`` by name; absent velocities have none.
        coverage: the states that imagination should know, a wide box around all that the task
            meets. Defaults to the reset box.
        goal: states around the goal, worth imagining from where the goal is hard to reach.
        exploration_reward: what to plan for while collecting data, where ``reward`` is too sparse
            to move the system. Defaults to ``reward``.
        integrator: how the world integrates, by name.
        env_id: id of the gymnasium environment of this world, if there is one.

    Raises:
        ValueError: for a field whose length or range does not fit the system, named in the message.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum-swingup")
        >>> state = task.reset.sample([3])
        >>> next_state = task.step(state, torch.zeros(3, 1))
        >>> task.reward(state, torch.zeros(3, 1), next_state).shape
        torch.Size([3])
    """

    name: str
    system: System
    action_high: tuple[float, ...]
    time_step: float
    max_steps: int
    reset: Box
    reward: RewardFn
    terminated: TerminatedFn | None = None
    velocity_limits: Mapping[str, float] = field(default_factory=dict, hash=False)
    coverage: Box | None = None
    goal: Box | None = None
    exploration_reward: RewardFn | None = None
    integrator: str = "semi_implicit_euler"
    env_id: str | None = None

    def __post_init__(self) -> None:
        if len(self.action_high) != self.system.action_dim:
            raise ValueError(
                f"action_high: expected {self.system.action_dim} values for "
                f"{self.system.action_names}, got {self.action_high}."
            )
        if any(not 0 < high < math.inf for high in self.action_high):
            raise ValueError(
                f"action_high: expected positive, finite bounds, got {self.action_high}."
            )
        if not 0 < self.time_step < math.inf:
            raise ValueError(
                f"time_step: expected a positive number of seconds, got {self.time_step}."
            )
        if not (isinstance(self.max_steps, int) and self.max_steps > 0):
            raise ValueError(
                f"max_steps: expected a positive whole number of steps, got {self.max_steps}."
            )
        for name in ("reset", "coverage", "goal"):
            box = getattr(self, name)
            if box is not None and len(box.low) != self.system.state_dim:
                raise ValueError(
                    f"{name}: expected {self.system.state_dim} values for "
                    f"{self.system.state_names}, got {len(box.low)}."
                )
        make_integrator(self.integrator)
        object.__setattr__(self, "velocity_limits", dict(self.velocity_limits))
        object.__setattr__(self, "layout", self.system.layout(self.velocity_limits))

    layout: StateLayout = field(init=False, repr=False, compare=False)
    """Positions, velocities and their limits, for integrators."""

    def step(
        self, state: Tensor, action: Tensor, integrator: str | Integrator | None = None
    ) -> Tensor:
        """One step of the real world with friction, ``[*batch, n], [*batch, m] -> [*batch, n]``.

        The action is clipped to its bounds and held for ``time_step`` seconds.
        """
        action = self.clip_action(action)
        return make_integrator(integrator or self.integrator)(
            lambda s: self.system.derivative(s, action), state, self.time_step, self.layout
        )

    def clip_action(self, action: Tensor) -> Tensor:
        """Clip an action ``[*batch, m]`` to its bounds."""
        return torch.stack(
            [
                a.clamp(-high, high)
                for a, high in zip(action.unbind(-1), self.action_high, strict=True)
            ],
            -1,
        )

    def is_terminated(self, next_state: Tensor) -> Tensor:
        """Whether ``next_state`` ``[*batch, n]`` ends the episode, bool ``[*batch]``."""
        if self.terminated is None:
            return torch.zeros(next_state.shape[:-1], dtype=torch.bool, device=next_state.device)
        return self.terminated(next_state)
