"""A task on a system, as data: reward, termination, limits and time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from phihp_torchrl.config import (
    INFINITE,
    ConfigError,
    check_count,
    check_fields,
    check_not_negative,
    check_positive,
    from_mapping,
)
from phihp_torchrl.integrators import StateLayout
from phihp_torchrl.systems import System, check_names
from phihp_torchrl.tasks.actuator import Actuator
from phihp_torchrl.tasks.actuator_part import ActuatorPart
from phihp_torchrl.tasks.bounds import read_limits
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
from phihp_torchrl.tasks.steps import RewardFn, Steps, TerminatedFn


@dataclass(frozen=True)
class Task(Steps):
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
        >>> import torch
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
        default_factory=dict, hash=False, metadata=INFINITE
    )
    position_limits: Mapping[str, tuple[float, float]] = field(
        default_factory=dict, hash=False, metadata=INFINITE
    )
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
        check_fields(self)
        if not isinstance(self.system, System):
            raise ConfigError("system", f"expected a System, got {self.system!r}.")
        check_names(self.system)
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

    def with_actuator(self, numbers: Mapping[str, Any]) -> Task:
        """Return the task with other numbers of its actuator, by name; none change nothing.

        Raises:
            ConfigError: for a number that an :class:`Actuator` does not have, or out of range.
        """
        if not numbers:
            return self
        ours = {} if self.actuator is None else self.actuator.config
        return replace(self, actuator=from_mapping(Actuator, {**ours, **numbers}, "actuator"))

    def with_constraints(self, numbers: Mapping[str, Any]) -> Task:
        """Return the task with other limits, by name of a state; none change nothing.

        Args:
            numbers: by name, ``low``, ``high``, ``price`` and ``hard`` as far as they differ from
                those of a constraint of that name; ``None`` drops it.

        Raises:
            ConfigError: for a name that is no state's nor a constraint's, and for a key or number
                that does not fit.
        """
        return replace(self, constraints=self.limits.changed(numbers)) if numbers else self

    def unpriced(self) -> Task:
        """Return the task as a world plays it: with the same state, and rewards without prices."""
        constraints = self.limits.unpriced()
        if not self.action_rate_cost and constraints == self.constraints:
            return self
        cost = None if self.action_rate_cost is None else 0.0
        return replace(self, action_rate_cost=cost, constraints=constraints)
