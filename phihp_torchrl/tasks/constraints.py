"""All constraints of a task: what violates them, what that costs, and what it ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, meant
from phihp_torchrl.systems import System, wrap
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.constraint import Constraint

_STARTS = 256
"""Starts of episodes by which a hard constraint of an angle or of a function is judged."""

_NUMBERS = ["low", "high", "price", "hard"]
"""What settings may say of a constraint."""


class Constraints:
    """The constraints of a task on its system, as functions of tensors.

    Args:
        each: the constraints.
        system: the system, which names states and angles; angles are judged in [-pi, pi).
        reset: box of the states in which episodes start.

    Raises:
        ConfigError: naming the constraint: for the name of no state, a name that is there twice, a
            function that fails or gives no value for each state, a hard one of a state outside
            which episodes start, and one of an angle, or of a function without ``action``, outside
            which all of them do.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("cartpole-swingup")
        >>> limits = Constraints([Constraint("x", -1.0, 1.0, price=5.0)], task.system, task.reset)
        >>> state = torch.tensor([[0.5, 0.0, 0.0, 0.0], [1.2, 0.0, 0.0, 0.0]])
        >>> limits.violations(state)
        tensor([[0.0000],
                [0.2000]])
        >>> limits.price(state)
        tensor([0.0000, 1.0000])
    """

    def __init__(self, each: Sequence[Constraint], system: System, reset: Box) -> None:
        if not isinstance(each, (tuple, list)) or not all(isinstance(c, Constraint) for c in each):
            raise ConfigError("constraints", f"expected a tuple of Constraint, got {each!r}.")
        self.each = tuple(each)
        self.names = tuple(constraint.name for constraint in each)
        self._system, self._reset = system, reset
        for constraint in self.each:
            self._check(constraint)

    def __bool__(self) -> bool:
        return bool(self.each)

    @property
    def ends_episodes(self) -> bool:
        """Whether one of them is hard."""
        return any(constraint.hard for constraint in self.each)

    def unpriced(self) -> tuple[Constraint, ...]:
        """The same constraints, soft ones only reported."""
        return tuple(replace(c, price=0.0) if c.price else c for c in self.each)

    def changed(self, numbers: Mapping[str, Any]) -> tuple[Constraint, ...]:
        """The same constraints with other numbers, and more of them, by name; null drops one.

        Args:
            numbers: by name, ``low``, ``high``, ``price`` and ``hard`` as far as they differ.

        Raises:
            ConfigError: for a name that is no constraint's and no state's, and for a key or a value
                that is none of a constraint's; it names the key.

        Examples:
            >>> from phihp_torchrl import get_task
            >>> limits = get_task("cartpole").limits
            >>> limits.changed({"x": {"high": 1.0, "price": 5.0}})[0].high
            1.0
        """
        found = {constraint.name: constraint for constraint in self.each}
        states = self._system.state_names
        for name, changes in numbers.items():
            if name not in found and name not in states:
                known = list(dict.fromkeys([*found, *states]))
                raise ConfigError(
                    f"constraints.{name}",
                    f"unknown name, expected one of the task's constraints {list(found)} or of the "
                    f"states {list(states)}{meant(name, known)}",
                )
            if changes is None:
                if found.pop(name, None) is None:
                    raise ConfigError(
                        f"constraints.{name}",
                        f"expected one of {list(self.names)} to drop, or limits, got null.",
                    )
                continue
            if not isinstance(changes, Mapping):
                raise ConfigError(
                    f"constraints.{name}", f"expected {_NUMBERS} by name, got {changes!r}."
                )
            if unknown := [key for key in changes if key not in _NUMBERS]:
                raise ConfigError(
                    f"constraints.{name}.{unknown[0]}", f"unknown key; expected one of {_NUMBERS}."
                )
            own = found.get(name)
            found[name] = replace(own, **changes) if own else Constraint(name, **changes)
        return tuple(found.values())

    def violations(self, state: Tensor, command: Tensor | None = None) -> Tensor:
        """How far each is violated after a step, in its physical units, ``[*batch, c]``.

        Args:
            state: physical state after the step, ``[*batch, n]``.
            command: command of the step, ``[*batch, m]``; needed by functions that read it.

        Raises:
            ConfigError: where a function reads the command, and there is none.
        """
        found = [self._violation(constraint, state, command) for constraint in self.each]
        return torch.stack(found, -1) if found else state.new_zeros([*state.shape[:-1], 0])

    def price(self, state: Tensor, command: Tensor | None = None) -> Tensor | None:
        """What the violations of a step cost, ``[*batch]``; ``None`` where none has a price."""
        total = None
        for constraint in self.each:
            if not constraint.price:
                continue
            violation = self._violation(constraint, state, command)
            paid = (violation > 0).to(violation.dtype) if constraint.hard else violation
            paid = constraint.price * paid
            total = paid if total is None else total + paid
        return total

    def ended(self, state: Tensor, command: Tensor | None = None) -> Tensor | None:
        """Whether a hard one is violated, bool ``[*batch]``; ``None`` where none is hard."""
        ended = None
        for constraint in self.each:
            if constraint.hard:
                beyond = self._violation(constraint, state, command) > 0
                ended = beyond if ended is None else ended | beyond
        return ended

    def _violation(self, constraint: Constraint, state: Tensor, command: Tensor | None) -> Tensor:
        name, function = constraint.name, constraint.function
        if function is None:
            value = state[..., self._system.state_names.index(name)]
            return constraint.violation(wrap(value) if name in self._system.angles else value)
        if not constraint.reads_action:
            return constraint.violation(function(state))
        if command is None:
            raise ConfigError(f"constraints.{name}", "expected the command, which it reads.")
        return constraint.violation(function(state, action=command))

    def _check(self, constraint: Constraint) -> None:
        name, system = constraint.name, self._system
        if self.names.count(name) > 1:
            raise ConfigError(f"constraints.{name}", "expected a name of its own, got it twice.")
        if constraint.function is not None:
            self._check_function(constraint)
            self._check_starts(constraint)
            return
        if name not in system.state_names:
            raise ConfigError(
                f"constraints.{name}",
                f"expected one of the states {system.state_names}, or a function"
                f"{meant(name, system.state_names)}",
            )
        if name in system.angles:
            limits = [v for v in (constraint.low, constraint.high) if v is not None]
            if any(abs(value) > torch.pi for value in limits):
                raise ConfigError(
                    f"constraints.{name}",
                    f"expected limits of an angle in [-pi, pi], got {limits}.",
                )
            self._check_starts(constraint)
            return
        index = system.state_names.index(name)
        ends = torch.tensor([self._reset.low[index], self._reset.high[index]], dtype=torch.float64)
        if constraint.hard and (constraint.violation(ends) > 0).any():
            raise ConfigError(
                f"constraints.{name}",
                "expected limits around the task's reset box, "
                f"{ends[0].item():g} to {ends[1].item():g}, since episodes start there.",
            )

    def _check_function(self, constraint: Constraint) -> None:
        key, system = f"constraints.{constraint.name}.function", self._system
        states, actions = torch.zeros(2, system.state_dim), torch.zeros(2, system.action_dim)
        expected = (
            "expected function(state) or function(state, action) that gives [*batch] for states "
            f"[*batch, {system.state_dim}] and actions [*batch, {system.action_dim}]"
        )
        try:
            shape = list(self._violation(constraint, states, actions).shape)
        # A user's function may raise anything; the message should name it and the reason.
        except Exception as error:
            reason = f"{expected}; it failed with {type(error).__name__}: {error}"
            raise ConfigError(key, reason) from error
        if shape != [2]:
            raise ConfigError(key, f"{expected}, so [2] for 2, got {shape}.")

    def _check_starts(self, constraint: Constraint) -> None:
        """Refuse a hard one that every start violates; what reads the action has none there."""
        if not constraint.hard or constraint.reads_action:
            return
        starts = self._reset.sample([_STARTS], generator=torch.Generator().manual_seed(0))
        if (self._violation(constraint, starts, None) > 0).all():
            raise ConfigError(
                f"constraints.{constraint.name}",
                f"expected limits that some starts of episodes keep, got low={constraint.low}, "
                f"high={constraint.high}, which all {_STARTS} drawn from the reset box violate.",
            )
