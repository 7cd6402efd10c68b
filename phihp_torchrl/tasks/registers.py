"""What a task adds to the physical state, as parts that are put together."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Seconds = float | Tensor
"""The duration of a step: a number, or a tensor ``[*batch]``."""


class Part(ABC):
    """A part of what a task adds to the physical state: some registers, and how they move.

    A command passes the parts on its way to the system, from the last part to the first, so the
    first part acts on the system directly. Registers are moved once a step and never integrated.
    Whatever a task adds, such as commands under way or the last action, is a subclass; a task makes
    its parts in :meth:`phihp_torchrl.Task.parts`, and everything above reads them through it.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> task = replace(get_task("pendulum"), action_rate_cost=0.1)
        >>> [(part.name, part.size) for part in task.parts()]
        [('last action', 1)]
    """

    name: str
    """What the part is called."""
    past: int = 0
    """The number of last commands that :meth:`random` needs."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of registers."""

    @abstractmethod
    def scales(self) -> tuple[Tensor, Tensor]:
        """Middle and half-range of each register, ``[size]``, in which observations have them."""

    @abstractmethod
    def rest(self, command: Tensor) -> Tensor:
        """Registers ``[*batch, size]`` after ``command`` ``[*batch, m]`` was held for long.

        An episode starts so, with the command nearest to zero.
        """

    @abstractmethod
    def random(self, commands: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Registers ``[*batch, size]`` in the middle of an episode.

        Args:
            commands: the commands before, ``[*batch, k, m]``, the newest last; at least
                :attr:`past`, and at least one.
            generator: source of further randomness, of the device of ``commands``.
        """

    @abstractmethod
    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        """Advance the registers by one step.

        Args:
            registers: the registers before the step, ``[*batch, size]``.
            command: what arrives at this part, ``[*batch, m]``.
            time_step: duration of the step.

        Returns:
            What this part passes on, as a mean over the step, ``[*batch, m]``, and the registers
            after the step.
        """

    def limit(self, registers: Tensor, command: Tensor, time_step: Seconds) -> Tensor:
        """The command that may be given in place of ``command`` ``[*batch, m]``."""
        return command

    def price(self, registers: Tensor, command: Tensor) -> Tensor | None:
        """What ``command`` costs where a task is imagined, ``[*batch]``; ``None`` for nothing."""
        return None

    def start(self, command: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Registers ``[*batch, size]`` in which an episode starts, by default at rest.

        Args:
            command: the command before, ``[*batch, m]``.
            generator: source of randomness.
        """
        return self.rest(command)

    def drift(self, registers: Tensor) -> Tensor | None:
        """What moves the physical state besides, ``[*batch, n]`` per second, or ``None``."""
        return None

    def memory(self, time_step: float) -> float:
        """Seconds after which the commands before have next to no effect on the registers."""
        return 0.0


class Registers:
    """The registers of a task: those of its parts, one after the other, ``[*batch, r]``.

    Args:
        parts: the parts; the first one is nearest to the system.

    Examples:
        >>> from phihp_torchrl.tasks import ActionBounds, LastAction
        >>> bounds = ActionBounds.from_limits([-2.0], [2.0])
        >>> registers = Registers([LastAction(bounds, rate_limit=10.0, cost=1.0)])
        >>> before, wanted = torch.tensor([0.5]), torch.tensor([2.0])
        >>> registers.command(before, wanted, time_step=0.1)
        tensor([1.5000])
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = tuple(parts)
        self.sizes = [part.size for part in self.parts]
        self.size = sum(self.sizes)
        self.past = max((part.past for part in self.parts), default=0)

    def split(self, registers: Tensor) -> list[tuple[Part, Tensor]]:
        """Each part with its registers."""
        return list(zip(self.parts, registers.split(self.sizes, -1), strict=True))

    def scales(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Middle and half-range of each register ``[r]``, with dtype and device of ``like``."""
        columns = zip(*(part.scales() for part in self.parts), strict=True)
        center, scale = (torch.cat(column).to(like) for column in columns)
        return center, scale

    def rest(self, command: Tensor) -> Tensor:
        """The registers after ``command`` ``[*batch, m]`` was held for long."""
        return _joined([part.rest(command) for part in self.parts], command)

    def start(self, command: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Registers in which an episode starts, after ``command`` ``[*batch, m]``."""
        return _joined([part.start(command, generator) for part in self.parts], command)

    def drift(self, registers: Tensor) -> Tensor | None:
        """What moves the physical state besides, ``[*batch, n]`` per second, or ``None``."""
        drifts = [part.drift(value) for part, value in self.split(registers)]
        known = [drift for drift in drifts if drift is not None]
        return sum(known[1:], known[0]) if known else None

    def random(self, commands: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Registers in the middle of an episode, after ``commands`` ``[*batch, k, m]``."""
        parts = [part.random(commands, generator) for part in self.parts]
        return _joined(parts, commands[..., 0, :])

    def command(self, registers: Tensor, action: Tensor, time_step: Seconds) -> Tensor:
        """The command ``[*batch, m]`` that may be given in place of an action in bounds."""
        for part, value in self.split(registers):
            action = part.limit(value, action, time_step)
        return action

    def price(self, registers: Tensor, command: Tensor) -> Tensor | None:
        """What a command costs where a task is imagined, ``[*batch]``; ``None`` for nothing."""
        prices = [part.price(value, command) for part, value in self.split(registers)]
        known = [price for price in prices if price is not None]
        return sum(known[1:], known[0]) if known else None

    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        """What acts on the system during a step ``[*batch, m]``, and the registers after it."""
        after = []
        for part, value in reversed(self.split(registers)):
            command, moved = part.step(value, command, time_step)
            after.append(moved)
        return command, _joined(after[::-1], command)

    def along(self, commands: Tensor, intervals: Seconds, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Follow the commands of an episode, which starts with nothing under way.

        Args:
            commands: the commands, ``[T, m]``.
            intervals: seconds for which each is held, a number or ``[T]``.
            rest: the command before the episode, ``[m]``.

        Returns:
            The mean action over each step, ``[T, m]``, and the registers before it, ``[T, r]``.
        """
        return follow(self.step, self.rest(rest), commands, intervals)

    def memory(self, time_step: float) -> float:
        """Seconds after which the commands before have next to no effect on the registers."""
        return max((part.memory(time_step) for part in self.parts), default=0.0)


def follow(
    step: Callable[[Tensor, Tensor, Seconds], tuple[Tensor, Tensor]],
    registers: Tensor,
    commands: Tensor,
    intervals: Seconds,
) -> tuple[Tensor, Tensor]:
    """Follow the commands of an episode, one step after the other.

    Args:
        step: what moves registers ``[r]`` by a command ``[m]`` that is held for some seconds.
        registers: the registers before the first step, ``[r]``.
        commands: the commands, ``[T, m]``.
        intervals: seconds for which each is held, a number or ``[T]``.

    Returns:
        The mean action over each step, ``[T, m]``, and the registers before it, ``[T, r]``.
    """
    seconds = torch.as_tensor(intervals, dtype=commands.dtype).expand(len(commands))
    acting, before = [], []
    for command, duration in zip(commands, seconds, strict=True):
        before.append(registers)
        action, registers = step(registers, command, duration)
        acting.append(action)
    return torch.stack(acting), torch.stack(before)


def _joined(parts: list[Tensor], like: Tensor) -> Tensor:
    return torch.cat(parts, -1) if parts else like[..., :0]
