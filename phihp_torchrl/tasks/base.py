"""A task on a system: reward, termination, limits and time step, and how a step is composed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_count, check_positive, from_mapping
from phihp_torchrl.integrators import StateLayout
from phihp_torchrl.systems import System
from phihp_torchrl.tasks.actuator import Actuator
from phihp_torchrl.tasks.bounds import ActionBounds
from phihp_torchrl.tasks.box import Box

RewardFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""``state [*batch, n], action [*batch, m], next_state [*batch, n] -> reward [*batch]``."""
TerminatedFn = Callable[[Tensor], Tensor]
"""``next_state [*batch, n] -> bool [*batch]``."""
Step = Callable[[Tensor, Tensor], Tensor]
"""``state, action [*batch, m] -> next_state``, of the system's components, for what acts on it."""


class Transition(NamedTuple):
    """The result of one step of a task.

    Args:
        next_state: state after the step, ``[*batch, n]``.
        reward: reward of the step, ``[*batch]``.
        terminated: whether the step ends the episode, bool ``[*batch]``.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> stay = lambda state, action: state
        >>> found = get_task("pendulum").transition(stay, torch.tensor([0.5, 0.0]), torch.ones(1))
        >>> round(found.reward.item(), 3), found.terminated.item()
        (-0.251, False)
    """

    next_state: Tensor
    reward: Tensor
    terminated: Tensor


@dataclass(frozen=True)
class Task:
    """A control task on a :class:`~phihp_torchrl.systems.System`, as data.

    A task describes the goal and not the world: it contains neither friction nor how a world is
    simulated. Learning, imagination and planning use the system through the task, so that all of
    them share one state, one observation and one definition of a step (:meth:`transition`).

    Args:
        name: name in settings, e.g. ``"pendulum-swingup"``.
        system: the system, as far as it is known.
        action_high: upper bound of each action, in physical units.
        time_step: seconds for which an action is held.
        max_steps: steps after which an episode is truncated, which is not a termination.
        reset: box of the states in which episodes start.
        reward: reward of a transition, a pure function of tensors.
        terminated: whether the next state ends the episode; ``None`` if episodes never terminate.
        velocity_limits: by name of the velocity, the largest ``|velocity|``, or the lowest and the
            highest velocity; velocities without an entry are not limited.
        position_limits: stops by name of the position: the lowest and the highest position.
        restitution: the share of its velocity with which a position leaves a stop, in [0, 1]; one
            number, or by name of the position.
        coverage: wide box around the states that the task visits, from which imagined episodes
            start as well; ``None`` for no such box.
        goal: box around the goal, from which imagined episodes start as well; useful where the goal
            is hard to reach.
        exploration_reward: reward that data collection plans for, where ``reward`` is too sparse to
            make the system move. Defaults to ``reward``.
        action_low: lower bound of each action. Defaults to the negative of ``action_high``.
        actuator: what happens to a command before it acts, such as dead time and lag. Commands that
            are under way then belong to the state, as registers behind the physical components;
            reward, end and dynamics see the physical components alone.

    Raises:
        ConfigError: for a field whose length or range does not fit the system; the message names
            the field.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum-swingup")
        >>> state = task.reset.sample([3])
        >>> stay = lambda state, action: state
        >>> task.transition(stay, state, torch.zeros(3, 1)).reward.shape
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
    velocity_limits: Mapping[str, float | tuple[float, float]] = field(
        default_factory=dict, hash=False
    )
    position_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict, hash=False)
    restitution: float | Mapping[str, float] = field(default=0.0, hash=False)
    coverage: Box | None = None
    goal: Box | None = None
    exploration_reward: RewardFn | None = None
    action_low: tuple[float, ...] | None = None
    actuator: Actuator | None = None

    layout: StateLayout = field(init=False, repr=False, compare=False)
    """Positions, velocities and their limits, for integrators."""

    def __post_init__(self) -> None:
        self._set_bounds()
        check_positive(self, "time_step")
        check_count(self, "max_steps")
        for name in ("reset", "coverage", "goal"):
            box = getattr(self, name)
            if box is not None and len(box.low) != self.system.state_dim:
                raise ConfigError(
                    name,
                    f"expected {self.system.state_dim} values for {self.system.state_names}, "
                    f"got {len(box.low)}.",
                )
        if self.actuator is not None:
            self.actuator.check(self.system.action_names)
        object.__setattr__(self, "velocity_limits", dict(self.velocity_limits))
        object.__setattr__(self, "position_limits", dict(self.position_limits))
        layout = self.system.layout(self.velocity_limits, self.position_limits, self.restitution)
        object.__setattr__(self, "layout", layout)

    def _set_bounds(self) -> None:
        names = self.system.action_names
        for name in ("action_high", "action_low"):
            given = getattr(self, name)
            if given is None:
                continue
            if len(given) != len(names):
                raise ConfigError(name, f"expected {len(names)} values for {names}, got {given}.")
            if not all(math.isfinite(value) for value in given):
                raise ConfigError(name, f"expected finite bounds, got {given}.")
            object.__setattr__(self, name, tuple(float(value) for value in given))
        if self.action_low is None:
            if not all(high > 0 for high in self.action_high):
                raise ConfigError(
                    "action_high",
                    f"expected positive bounds where action_low is not given, "
                    f"got {self.action_high}.",
                )
            object.__setattr__(self, "action_low", tuple(-high for high in self.action_high))
        pairs = zip(self.action_low or (), self.action_high, strict=True)
        if not all(low < high for low, high in pairs):
            raise ConfigError(
                "action_low", f"expected values below {self.action_high}, got {self.action_low}."
            )

    # Sizes and maps of states, observations and actions, for everything that uses a task.

    @property
    def register_count(self) -> int:
        """Number of registers, ``r``: what is under way between commands and their effect."""
        return 0 if self.actuator is None else self.actuator.registers(self.action_dim)

    @property
    def state_dim(self) -> int:
        """Number of state components, ``n``: those of the system, and then the registers."""
        return self.system.state_dim + self.register_count

    @property
    def action_dim(self) -> int:
        """Number of action components, ``m``."""
        return self.system.action_dim

    @property
    def observation_dim(self) -> int:
        """Number of observation components, ``o``: those of the system, and the registers."""
        return self.system.observation_dim + self.register_count

    @property
    def bounds(self) -> ActionBounds:
        """Bounds of the action, float32 ``[m]``, on the CPU."""
        return ActionBounds.from_limits(self.action_low or (), self.action_high)

    def observe(self, state: Tensor) -> Tensor:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``; registers in half-ranges."""
        if not self.register_count:
            return self.system.observe(state)
        physical, registers = self.split(state)
        return self.complete(self.system.observe(physical), registers)

    def locate(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""
        if not self.register_count:
            return self.system.locate(observation)
        size = self.system.observation_dim
        center, scale = self._register_scales(observation)
        registers = center + scale * observation[..., size:]
        return torch.cat([self.system.locate(observation[..., :size]), registers], -1)

    def _register_scales(self, like: Tensor) -> tuple[Tensor, Tensor]:
        assert self.actuator is not None
        bounds = self.bounds
        scales = self.actuator.scales(bounds.center.to(like), bounds.scale.to(like))
        return scales[0], scales[1]

    # The registers of a task with an actuator; without one, states are physical as they are.

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Split a state ``[*batch, n]`` into its physical components and its registers."""
        size = self.system.state_dim
        return state[..., :size], state[..., size:]

    def with_actuator(self, numbers: Mapping[str, Any]) -> Task:
        """Return the task with other numbers of its actuator, by name; none change nothing.

        Raises:
            ConfigError: for a number that an :class:`Actuator` does not have, or out of range.
        """
        if not numbers:
            return self
        ours = {} if self.actuator is None else self.actuator.config
        return replace(self, actuator=from_mapping(Actuator, {**ours, **numbers}, "actuator"))

    def at_rest(self, physical: Tensor) -> Tensor:
        """The state ``[*batch, n]`` of physical components with nothing under way."""
        if not self.register_count:
            return physical
        return torch.cat([physical, self.rest(physical)], -1)

    def sample_start(
        self, shape: torch.Size | list[int], generator: torch.Generator | None = None
    ) -> Tensor:
        """Draw states ``[*shape, n]`` in which episodes start, with nothing under way."""
        return self.at_rest(self.reset.sample(shape, generator=generator))

    def complete(self, observation: Tensor, registers: Tensor) -> Tensor:
        """The task's observation ``[*batch, o]`` from one of the system's and the registers."""
        center, scale = self._register_scales(observation)
        return torch.cat([observation, (registers.to(observation.dtype) - center) / scale], -1)

    def rest(self, like: Tensor) -> Tensor:
        """The registers ``[*batch, r]`` with nothing under way, for a tensor ``[*batch, ...]``."""
        still = torch.zeros_like(like[..., :1]).expand(*like.shape[:-1], self.action_dim)
        return (
            like[..., :0] if self.actuator is None else self.actuator.rest(self.clip_action(still))
        )

    def acting(self, registers: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return what acts on the system during a step, and the registers after it.

        Args:
            registers: the registers before the step, ``[*batch, r]``.
            action: the command of the step, ``[*batch, m]``; it is clipped to its bounds.
        """
        action = self.clip_action(action)
        if self.actuator is None:
            return action, registers
        return self.actuator.step(registers, action, self.time_step)

    def difference(self, state: Tensor, other: Tensor) -> Tensor:
        """``state - other``, with differences of angles in [-pi, pi); registers may be left out."""
        return self.system.difference(state, other)

    # One step of the task.

    def transition(self, step: Step, state: Tensor, action: Tensor) -> Transition:
        """Take one step of the task, in which ``step`` (of a world or a model) moves the state.

        This is the only place where an action is clipped, what is under way moves on, the state is
        moved, the reward is computed and the termination is decided.

        Args:
            step: ``(physical state, action) -> next physical state``.
            state: the state before the step, ``[*batch, n]``.
            action: the action, in physical units, ``[*batch, m]``; it is clipped to its bounds.

        Returns:
            The next state, the reward and whether the episode has terminated.
        """
        action = self.clip_action(action)
        if self.actuator is None:
            next_state = moved = step(state, action)
        else:
            state, registers = self.split(state)
            acting, registers = self.actuator.step(registers, action, self.time_step)
            moved = step(state, acting)
            next_state = torch.cat([moved, registers], -1)
        return Transition(next_state, self.reward(state, action, moved), self.is_terminated(moved))

    def clip_action(self, action: Tensor) -> Tensor:
        """Clip an action ``[*batch, m]`` to its bounds."""
        limits = zip(action.unbind(-1), self.action_low or (), self.action_high, strict=True)
        return torch.stack([a.clamp(low, high) for a, low, high in limits], -1)

    def is_terminated(self, next_state: Tensor) -> Tensor:
        """Whether ``next_state`` ``[*batch, n]`` ends the episode, bool ``[*batch]``."""
        if self.terminated is None:
            return torch.zeros(next_state.shape[:-1], dtype=torch.bool, device=next_state.device)
        return self.terminated(self.split(next_state)[0])
