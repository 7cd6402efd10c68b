"""A box from which states are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phihp_torchrl.config import LARGEST_FLOAT32, ConfigError, check_fields


@dataclass(frozen=True)
class Box:
    """An axis-aligned box of states, sampled uniformly.

    Args:
        low: lower corner, one number per state component.
        high: upper corner.

    Raises:
        ConfigError: for corners of different lengths, or that are not finite and in order.

    Examples:
        >>> Box(low=(-1.0, 0.0), high=(1.0, 0.0)).sample([5]).shape
        torch.Size([5, 2])
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        check_fields(self)
        if len(self.low) != len(self.high):
            raise ConfigError("low, high", f"expected equal lengths, got {self.low}, {self.high}.")
        pairs = zip(self.low, self.high, strict=True)
        if any(not (low <= high and high - low <= LARGEST_FLOAT32) for low, high in pairs):
            raise ConfigError(
                "low, high", f"expected finite low <= high, got {self.low}, {self.high}."
            )

    @classmethod
    def around(cls, center: tuple[float, ...], radius: tuple[float, ...]) -> Box:
        """Return the box ``center ± radius``.

        Raises:
            ConfigError: if the two have different lengths.
        """
        if len(center) != len(radius):
            raise ConfigError("center, radius", f"expected equal lengths, got {center}, {radius}.")
        pairs = list(zip(center, radius, strict=True))
        return cls(tuple(c - r for c, r in pairs), tuple(c + r for c, r in pairs))

    def sample(
        self,
        shape: torch.Size | list[int],
        *,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw states ``[*shape, n]``."""
        low = torch.tensor(self.low, dtype=dtype, device=device)
        high = torch.tensor(self.high, dtype=dtype, device=device)
        noise = torch.rand([*shape, len(self.low)], generator=generator, dtype=dtype, device=device)
        return low + (high - low) * noise
