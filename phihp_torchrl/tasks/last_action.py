"""The last action as a part of the state: limits and prices of the action's rate."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.tasks.bounds import ActionBounds
from phihp_torchrl.tasks.numbers import Numbers, one_each
from phihp_torchrl.tasks.registers import Part, Seconds


class LastAction(Part):
    r"""Keeps the last command, so that its rate can be limited and a change of it has a price.

    A command is brought within ``rate_limit * time_step`` of the last one. Its change costs

    .. math:: c \sum_i \left(\frac{a_{t,i} - a_{t-1,i}}{s_i}\right)^2

    where c is the price and s the half-range of the action.

    Args:
        bounds: bounds of the action, ``[m]``.
        rate_limit: largest rate of each action in its units per second; ``None`` for none.
        cost: the price c; 0 for none.

    Examples:
        >>> last = LastAction(ActionBounds.from_limits([-2.0], [2.0]), rate_limit=None, cost=0.5)
        >>> last.price(torch.tensor([-2.0]), torch.tensor([2.0]))  # from one bound to the other
        tensor(2.)
    """

    name = "last action"
    past = 1

    def __init__(self, bounds: ActionBounds, *, rate_limit: Numbers | None, cost: float) -> None:
        self.bounds = bounds
        self.cost = cost
        self._half_ranges = bounds.scale.tolist()
        self._rates = None if rate_limit is None else one_each(rate_limit, self.size)

    @property
    def size(self) -> int:
        return len(self.bounds.scale)

    def scales(self) -> tuple[Tensor, Tensor]:
        return self.bounds.center, self.bounds.scale

    def rest(self, command: Tensor) -> Tensor:
        return command

    def random(self, commands: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return commands[..., -1, :]

    def limit(self, registers: Tensor, command: Tensor, time_step: Seconds) -> Tensor:
        if self._rates is None:
            return command
        columns = zip(registers.unbind(-1), command.unbind(-1), self._rates, strict=True)
        limited = [
            wanted.clamp(last - rate * time_step, last + rate * time_step)
            for last, wanted, rate in columns
        ]
        return torch.stack(limited, -1)

    def price(self, registers: Tensor, command: Tensor) -> Tensor | None:
        if not self.cost:
            return None
        columns = zip((command - registers).unbind(-1), self._half_ranges, strict=True)
        return self.cost * sum((change / half).square() for change, half in columns)

    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        return command, command

    def memory(self, time_step: float) -> float:
        return time_step
