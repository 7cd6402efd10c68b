"""The parameters of a module as one vector, for second-order methods."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class ParameterVector:
    """Reads and writes all parameters of a module as one vector ``[p]``.

    Args:
        module: the module.

    Examples:
        >>> vector = ParameterVector(nn.Linear(2, 1))
        >>> vector.write(torch.arange(3.0))
        >>> vector.read(), vector.named["bias"].data
        (tensor([0., 1., 2.]), tensor([2.]))
    """

    def __init__(self, module: nn.Module) -> None:
        self.named = dict(module.named_parameters())
        self.sizes = [p.numel() for p in self.named.values()]

    def read(self) -> Tensor:
        """A copy of the current values, ``[p]``."""
        return torch.cat([p.detach().reshape(-1) for p in self.named.values()])

    @torch.no_grad()
    def write(self, theta: Tensor) -> None:
        """Set all parameters to ``theta`` ``[p]``."""
        for name, value in self.unpack(theta).items():
            self.named[name].copy_(value)

    def unpack(self, theta: Tensor, prefix: str = "") -> dict[str, Tensor]:
        """The parts of ``theta`` ``[p]`` in their shapes, by name behind ``prefix``."""
        parts = zip(self.named.items(), theta.split(self.sizes), strict=True)
        return {f"{prefix}{name}": part.reshape(p.shape) for (name, p), part in parts}
