"""What is under way in an actuator as a part of a task's state."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.tasks.actuator import Actuator
from phihp_torchrl.tasks.bounds import ActionBounds
from phihp_torchrl.tasks.registers import Part, Seconds


class ActuatorPart(Part):
    """The registers of an actuator as a part of a task's state.

    Args:
        actuator: the actuator.
        bounds: bounds of the action, ``[m]``.

    Examples:
        >>> bounds = ActionBounds.from_limits([-2.0], [2.0])
        >>> late = ActuatorPart(Actuator(delay_steps=1.0), bounds)
        >>> late.step(torch.tensor([0.5]), torch.tensor([1.0]), time_step=0.04)
        (tensor([0.5000]), tensor([1.]))
    """

    name = "actuator"

    def __init__(self, actuator: Actuator, bounds: ActionBounds) -> None:
        self.actuator, self.bounds = actuator, bounds
        self.past = actuator.places(len(bounds.scale))

    @property
    def size(self) -> int:
        return self.actuator.registers(len(self.bounds.scale))

    def scales(self) -> tuple[Tensor, Tensor]:
        return self.actuator.scales(self.bounds.center, self.bounds.scale)

    def rest(self, command: Tensor) -> Tensor:
        return self.actuator.rest(command)

    def random(self, commands: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.actuator.random(commands)

    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        return self.actuator.step(registers, command, time_step)

    def memory(self, time_step: float) -> float:
        return self.actuator.memory(time_step)
