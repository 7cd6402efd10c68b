"""One step of a task: what of an action acts, what moves, what is earned, and what ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks.constraints import Constraints
from phihp_torchrl.tasks.states import States

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


class Steps(States):
    """How a step of a task is composed.

    A :class:`~phihp_torchrl.Task` is one of these; it has the fields that they read.
    """

    if TYPE_CHECKING:  # fields of the task

        @property
        def time_step(self) -> float: ...
        @property
        def reward(self) -> RewardFn: ...
        @property
        def terminated(self) -> TerminatedFn | None: ...
        @property
        def limits(self) -> Constraints: ...
        @property
        def _reads(self) -> Mapping[str, tuple[str, ...]]: ...

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
        command, next_state = self.move(step, state, action)
        reward, terminated = self.judge(state, command, next_state)
        return Transition(next_state, reward, terminated)

    def move(self, step: Step, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The first half of :meth:`transition`: what is commanded, and where it leads.

        Returns:
            The command ``[*batch, m]`` and the next state ``[*batch, n]``.
        """
        before, registers = self.split(state)
        command = self.command(registers, action)
        if not self.register_count:
            return command, step(state, command)
        acting, after = self.registers.step(registers, command, self.time_step)
        moved = step(before, acting)
        if (drift := self.registers.drift(registers)) is not None:
            moved = moved + self.time_step * drift
        return command, torch.cat([moved, after], -1)

    def judge(self, state: Tensor, command: Tensor, next_state: Tensor) -> tuple[Tensor, Tensor]:
        """The second half of :meth:`transition`, for one step or for many at once.

        Args:
            state: the state before the step, ``[*batch, n]``.
            command: the command of the step, ``[*batch, m]``.
            next_state: the state after it, ``[*batch, n]``.

        Returns:
            The reward less the prices, and (bool) whether the episode ends, each ``[*batch]``.
        """
        reward = self.earned(state, command, next_state)
        (_, registers), (moved, _) = self.split(state), self.split(next_state)
        if (price := self._price(registers, command, moved)) is not None:
            reward = reward - price
        return reward, self.is_terminated(next_state, command)

    @property
    def may_end(self) -> bool:
        """Whether any state can end an episode."""
        return self.terminated is not None or self.limits.ends_episodes

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
