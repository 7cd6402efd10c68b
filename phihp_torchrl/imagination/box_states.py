"""What draws start states, and the plainest of them: uniformly from a box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from phihp_torchrl.tasks import Box


class StartStates(Protocol):
    """The interface of everything that draws start states of imagined episodes.

    The states are drawn on the device of the generator (the CPU if there is none) and then moved,
    so a seed gives the same states on every device.

    Examples:
        >>> class Zeros:
        ...     def sample(self, shape, generator=None, device=None):
        ...         return torch.zeros(*shape, 2, device=device)
        >>> zeros: StartStates = Zeros()
        >>> zeros.sample([3]).shape
        torch.Size([3, 2])
    """

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw states ``[*shape, n]``, float32, on ``device``."""


class BoxStates:
    """Start states drawn uniformly from a box.

    Args:
        box: the box of states.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> BoxStates(get_task("pendulum").reset).sample([5]).shape
        torch.Size([5, 2])
    """

    def __init__(self, box: Box) -> None:
        self.box = box

    def sample(
        self,
        shape: Sequence[int],
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        states = self.box.sample([*shape], generator=generator, device=draw_device(generator))
        return states.to(device)


def draw_device(generator: torch.Generator | None) -> torch.device:
    """The device on which a generator draws: its own, or the CPU without one."""
    return torch.device("cpu") if generator is None else generator.device
