"""The registers of references and inputs as parts of a task's state."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.tasks.registers import Part, Seconds
from phihp_torchrl.tasks.signal import Signal


class SignalPart(Part):
    """The known values of a signal, which commands pass without a change.

    Args:
        name: ``"reference"`` or ``"inputs"``, the key under which a caller gives it.
        signal: the signal.
        time_step: seconds in a step.
        acts: whether its present value acts on the system beside the command, as inputs do.

    Examples:
        >>> wind = Signal(("wind",), low=(-5.0,), high=(5.0,))
        >>> part = SignalPart("inputs", wind, time_step=0.02, acts=True)
        >>> part.step(torch.tensor([3.0]), torch.tensor([1.0]), time_step=0.02)
        (tensor([1., 3.]), tensor([3.]))
    """

    def __init__(self, name: str, signal: Signal, time_step: float, *, acts: bool) -> None:
        self.name, self.signal = name, signal
        self.time_step, self.acts = time_step, acts

    @property
    def size(self) -> int:
        return self.signal.registers

    def scales(self) -> tuple[Tensor, Tensor]:
        return self.signal.scales(torch.zeros(()))

    def rest(self, command: Tensor) -> Tensor:
        """The middle of the range, ``[*batch, size]``, until a value is drawn or given."""
        middle = self.signal.scales(command)[0]
        return middle.expand(*command.shape[:-1], -1)

    def start(self, command: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The first known values ``[*batch, size]`` of a trajectory drawn at random."""
        shape, rows = command.shape[:-1], self.signal.rows
        return self.signal.draw(shape, rows, self.time_step, generator).flatten(-2).to(command)

    def random(self, commands: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.start(commands[..., 0, :], generator)

    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        passed = command
        if self.acts:
            passed = torch.cat([command, self.signal.value(registers).to(command)], -1)
        return passed, self.signal.shift(registers)
