"""A task on a system: reward, termination, limits and time step, and how a step is composed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import (
    ConfigError,
    check_count,
    check_not_negative,
    check_positive,
    from_mapping,
)
from phihp_torchrl.integrators import StateLayout
from phihp_torchrl.systems import System
from phihp_torchrl.tasks.actuator import Actuator
from phihp_torchrl.tasks.actuator_part import ActuatorPart
from phihp_torchrl.tasks.bounds import ActionBounds, read_limits
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.constraint import Constraint
from phihp_torchrl.tasks.constraints import Constraints
from phihp_torchrl.tasks.disturbance import Disturbance, DisturbancePart
from phihp_torchrl.tasks.last_action import LastAction
from phihp_torchrl.tasks.numbers import Numbers, check_each, read_numbers
from phihp_torchrl.tasks.outside import Outside, named
from phihp_torchrl.tasks.registers import Part, Registers
from phihp_torchrl.tasks.signal import Signal
from phihp_torchrl.tasks.signal_parts import SignalPart

RewardFn = Callable[..., Tensor]
"""``state [*batch, n], action [*batch, m], next_state [*batch, n] -> reward [*batch]``.

With a parameter ``reference`` or ``inputs`` it gets that signal too, ``[*batch, k]``."""
TerminatedFn = Callable[..., Tensor]
"""``next_state [*batch, n] -> bool [*batch]``; it may have those parameters as well."""
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
        action_rate_limit: largest rate of each action in its units per second: one number, or one
            for each; ``None`` for none. Every command is brought within it, from the last one on,
            which then belongs to the state.
        action_rate_cost: price c of a change of the action from step to step:
            ``c * sum(((a_t - a_{t-1}) / half_range) ** 2)``. It is taken from the reward where the
            task is imagined, and never in a world (:meth:`unpriced`). The last action then belongs
            to the state, with a price of 0 too; ``None`` for neither.
        reference: what is to be followed, such as a set point or a trajectory. Its present value,
            and its preview, belong to the state. A reward with a fourth parameter of the name
            ``reference`` gets its value at the end of the step, as far as it was known before.
        inputs: what acts on the system without being commanded, and is measured, such as wind. Its
            components are the system's :attr:`~phihp_torchrl.System.input_names`.
        disturbance: an unmeasured drift that lasts, which an agent estimates while it acts.
        constraints: limits of states, or of functions of state and action: soft ones at a price,
            hard ones that end the episode. Evaluations report their violations.

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
    action_rate_limit: Numbers | None = None
    action_rate_cost: float | None = None
    reference: Signal | None = None
    inputs: Signal | None = None
    disturbance: Disturbance | None = None
    constraints: tuple[Constraint, ...] = ()

    layout: StateLayout = field(init=False, repr=False, compare=False)
    """Positions, velocities and their limits, for integrators."""
    registers: Registers = field(init=False, repr=False, compare=False)
    """What the task adds to the physical state."""
    outside: Outside = field(init=False, repr=False, compare=False)
    """The reference and the inputs, which are the first of the registers."""
    limits: Constraints = field(init=False, repr=False, compare=False)
    """The constraints, as functions of tensors."""
    _reads: dict[str, tuple[str, ...]] = field(
        init=False, repr=False, compare=False, default_factory=dict
    )

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
        if self.action_rate_limit is not None:
            limit = read_numbers("action_rate_limit", self.action_rate_limit, positive=True)
            check_each("action_rate_limit", limit, self.system.action_names)
            object.__setattr__(self, "action_rate_limit", limit)
        if self.action_rate_cost is not None:
            check_not_negative(self, "action_rate_cost")
        object.__setattr__(self, "velocity_limits", dict(self.velocity_limits))
        object.__setattr__(self, "position_limits", dict(self.position_limits))
        layout = self.system.layout(self.velocity_limits, self.position_limits, self.restitution)
        object.__setattr__(self, "layout", layout)
        object.__setattr__(self, "limits", Constraints(self.constraints, self.system, self.reset))
        object.__setattr__(self, "constraints", self.limits.each)
        self._check_outside()
        parts = self.parts()
        object.__setattr__(self, "registers", Registers(parts))
        signals = [part for part in parts if isinstance(part, SignalPart)]
        object.__setattr__(self, "outside", Outside(signals))
        keys = self.outside.signals
        self._reads.update({f: named(getattr(self, f), keys) for f in ("reward", "terminated")})

    def _check_outside(self) -> None:
        given, needed = self.inputs.names if self.inputs else (), self.system.input_names
        if given != needed:
            raise ConfigError("inputs", f"expected the system's inputs {needed}, got {given}.")
        if self.disturbance is not None:
            self.disturbance.check(self.system)
        functions = (self.reward, self.exploration_reward, self.terminated)
        read = any(named(function, ["reference"]) for function in functions)
        if read and self.reference is None:
            raise ConfigError("reference", "expected one, for the reward reads it; got none.")
        if self.reference is not None and not read:
            raise ConfigError(
                "reward",
                "expected a parameter named 'reference' (state, action, next_state, reference), "
                "else nothing depends on the task's reference.",
            )

    def _set_bounds(self) -> None:
        low, high = read_limits(self.system.action_names, self.action_low, self.action_high)
        object.__setattr__(self, "action_low", low)
        object.__setattr__(self, "action_high", high)

    def parts(self) -> list[Part]:
        """Make the parts that the task adds to the physical state; the first acts on the system."""
        bounds, parts = self.bounds, list[Part]()
        # Signals come first: a world shows them behind its observation, and no other registers.
        if self.inputs is not None:
            parts.append(SignalPart("inputs", self.inputs, self.time_step, acts=True))
        if self.reference is not None:
            parts.append(SignalPart("reference", self.reference, self.time_step, acts=False))
        if self.disturbance is not None:
            parts.append(DisturbancePart(self.disturbance, self.system))
        if self.actuator is not None:
            parts.append(ActuatorPart(self.actuator, bounds))
        limit, cost = self.action_rate_limit, self.action_rate_cost
        if limit is not None or cost is not None:
            parts.append(LastAction(bounds, rate_limit=limit, cost=cost or 0.0))
        return parts

    # Sizes and maps of states, observations and actions, for everything that uses a task.

    @property
    def register_count(self) -> int:
        """Number of registers, ``r``: of all that the task adds to the physical state."""
        return self.registers.size

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
    def shown_dim(self) -> int:
        """Number of components that a world shows: the system's observation, and the signals."""
        return self.system.observation_dim + self.outside.size

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
        center, scale = self.registers.scales(observation)
        registers = center + scale * observation[..., size:]
        return torch.cat([self.system.locate(observation[..., :size]), registers], -1)

    # The registers of a task that adds some; without them, states are physical as they are.

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
        """Draw states ``[*shape, n]`` in which episodes start, with nothing under way.

        References and inputs are drawn too.
        """
        return self.at_start(self.reset.sample(shape, generator=generator), generator)

    def at_start(self, physical: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The state ``[*batch, n]`` of physical components in which an episode starts."""
        if not self.register_count:
            return physical
        still = physical.new_zeros([*physical.shape[:-1], self.action_dim])
        registers = self.registers.start(self.clip_action(still), generator)
        return torch.cat([physical, registers], -1)

    def complete(self, observation: Tensor, registers: Tensor) -> Tensor:
        """The task's observation ``[*batch, o]`` from one of the system's and the registers.

        Args:
            observation: the system's observation, perhaps with the first registers behind it.
            registers: all registers, ``[*batch, r]``; those that are in the observation are not
                used.
        """
        center, scale = self.registers.scales(observation)
        known = observation.shape[-1] - self.system.observation_dim
        scaled = (registers.to(observation.dtype) - center) / scale
        return torch.cat([observation, scaled[..., known:]], -1)

    def with_signals(self, state: Tensor, signals: Tensor) -> Tensor:
        """The state ``[*batch, n]`` with other signals, registers ``[*batch, outside.size]``."""
        physical, registers = self.split(state)
        return torch.cat([physical, self.outside.replaced(registers, signals)], -1)

    def rest(self, like: Tensor) -> Tensor:
        """The registers ``[*batch, r]`` with nothing under way, for a tensor ``[*batch, ...]``."""
        still = torch.zeros_like(like[..., :1]).expand(*like.shape[:-1], self.action_dim)
        return self.registers.rest(self.clip_action(still))

    def random_registers(
        self, shape: Sequence[int], generator: torch.Generator | None = None
    ) -> Tensor:
        """Draw registers ``[*shape, r]`` as in the middle of an episode, on the generator's device.

        The commands before are uniform in their bounds.
        """
        device = torch.device("cpu") if generator is None else generator.device
        size = [*shape, max(self.registers.past, 1), self.action_dim]
        unit = torch.rand(size, generator=generator, device=device).mul(2).sub(1)
        return self.registers.random(self.bounds.to(device).from_unit(unit), generator)

    def command(self, registers: Tensor, action: Tensor) -> Tensor:
        """The command that is given for an action: in its bounds, and within its rate.

        Args:
            registers: the registers before the step, ``[*batch, r]``.
            action: the action of the step, ``[*batch, m]``.
        """
        return self.registers.command(registers, self.clip_action(action), self.time_step)

    def acting(self, registers: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return what acts on the system during a step, and the registers after it.

        Args:
            registers: the registers before the step, ``[*batch, r]``.
            action: the action of the step, ``[*batch, m]``; :meth:`command` is made of it.
        """
        return self.registers.step(registers, self.command(registers, action), self.time_step)

    def difference(self, state: Tensor, other: Tensor) -> Tensor:
        """``state - other``, with differences of angles in [-pi, pi); registers may be left out."""
        return self.system.difference(state, other)

    # One step of the task.

    def transition(self, step: Step, state: Tensor, action: Tensor) -> Transition:
        """Take one step of the task, in which ``step`` (of a world or a model) moves the state.

        This is the only place where an action becomes a command, what is under way moves on, the
        state is moved, the reward and its prices are computed and the termination is decided.

        Args:
            step: ``(physical state, action) -> next physical state``.
            state: the state before the step, ``[*batch, n]``.
            action: the action, in physical units, ``[*batch, m]``; see :meth:`command`.

        Returns:
            The next state, the reward less the prices of :meth:`price`, and whether the episode has
            terminated.
        """
        before, registers = self.split(state)
        action = self.command(registers, action)
        if not self.register_count:
            next_state = moved = step(state, action)
        else:
            acting, after = self.registers.step(registers, action, self.time_step)
            moved = step(before, acting)
            if (drift := self.registers.drift(registers)) is not None:
                moved = moved + self.time_step * drift
            next_state = torch.cat([moved, after], -1)
        reward = self.earned(state, action, next_state)
        if (price := self._price(registers, action, moved)) is not None:
            reward = reward - price
        return Transition(next_state, reward, self.is_terminated(next_state, action))

    def earned(self, state: Tensor, command: Tensor, next_state: Tensor) -> Tensor:
        """The reward of a step without prices, ``[*batch]``.

        Args:
            state: the state before the step, ``[*batch, n]``.
            command: the command of the step, ``[*batch, m]``.
            next_state: the state after it, ``[*batch, n]``.
        """
        (before, _), (moved, after) = self.split(state), self.split(next_state)
        return self.reward(before, command, moved, **self._signals_of("reward", after))

    def _signals_of(self, function: str, registers: Tensor) -> dict[str, Tensor]:
        """The signals that a function of the task reads, by the names of its parameters."""
        if not (keys := self._reads[function]):
            return {}
        values = self.outside.values(registers)
        return {key: values[key] for key in keys}

    def price(
        self, state: Tensor, action: Tensor, next_state: Tensor | None = None
    ) -> Tensor | None:
        """What a step costs where the task is imagined, ``[*batch]``; ``None`` for nothing.

        A world gives rewards without prices, so whoever learns from its steps subtracts them.

        Args:
            state: the state before the step, ``[*batch, n]``.
            action: the action of the step, ``[*batch, m]``.
            next_state: the state after it, ``[*batch, n]``, which constraints are judged by.

        Raises:
            ConfigError: without a ``next_state`` where the task has constraints.
        """
        _, registers = self.split(state)
        moved = None if next_state is None else self.split(next_state)[0]
        return self._price(registers, self.command(registers, action), moved)

    def _price(self, registers: Tensor, command: Tensor, moved: Tensor | None) -> Tensor | None:
        if self.limits and moved is None:
            raise ConfigError("next_state", "expected one, for the task has constraints.")
        price = self.registers.price(registers, command)
        more = None if moved is None else self.limits.price(moved, command)
        return price if more is None else more if price is None else price + more

    def unpriced(self) -> Task:
        """Return the task as a world plays it: with the same state, and rewards without prices."""
        constraints = self.limits.unpriced()
        if not self.action_rate_cost and constraints == self.constraints:
            return self
        cost = None if self.action_rate_cost is None else 0.0
        return replace(self, action_rate_cost=cost, constraints=constraints)

    def clip_action(self, action: Tensor) -> Tensor:
        """Clip an action ``[*batch, m]`` to its bounds."""
        limits = zip(action.unbind(-1), self.action_low or (), self.action_high, strict=True)
        return torch.stack([a.clamp(low, high) for a, low, high in limits], -1)

    def is_terminated(self, next_state: Tensor, command: Tensor | None = None) -> Tensor:
        """Whether ``next_state`` ``[*batch, n]`` ends the episode, bool ``[*batch]``.

        The command ``[*batch, m]`` is needed where a hard constraint reads the action.
        """
        moved, registers = self.split(next_state)
        ended = self.limits.ended(moved, command)
        if self.terminated is None:
            none = torch.zeros(next_state.shape[:-1], dtype=torch.bool, device=next_state.device)
            return none if ended is None else ended
        own = self.terminated(moved, **self._signals_of("terminated", registers))
        return own if ended is None else own | ended
