"""Bounds of an action, and the unit in which noise on it is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError

Limits = tuple[float, ...]


class ActionBounds(NamedTuple):
    """Bounds of an action with their middle and half-range, ``[m]`` each, in physical units.

    Networks read and write actions in units of the half-range around the middle, so that bounds may
    be asymmetric, such as -6 to 12 V or 0 to 100 %.

    Args:
        low: lower bounds.
        high: upper bounds.
        center: the middle; where a bound is missing, zero, or if that is nearer to the other bound
            than one, the value at a distance of one from it.
        scale: the half-range; one where a bound is missing.

    Examples:
        >>> bounds = ActionBounds.from_limits(torch.tensor([0.0]), torch.tensor([100.0]))
        >>> bounds.to_unit(torch.tensor([75.0])), bounds.clip(torch.tensor([120.0]))
        (tensor([0.5000]), tensor([100.]))
    """

    low: Tensor
    high: Tensor
    center: Tensor
    scale: Tensor

    @classmethod
    def from_limits(
        cls, low: Tensor | Sequence[float], high: Tensor | Sequence[float]
    ) -> ActionBounds:
        """Bounds ``[m]`` with their middle and half-range.

        Limits may be infinite, or the largest numbers of their dtype, which stand for no limit too.
        """
        low, high = torch.as_tensor(low), torch.as_tensor(high)
        half = high / 2 - low / 2
        most = torch.finfo(half.dtype).max
        bounded = (low > -most) & (high < most)
        # With one bound alone, samples around zero would all be clipped to a bound above it.
        inside = torch.zeros_like(half).clamp(low + 1, high - 1)
        center = torch.where(bounded, low / 2 + high / 2, inside)
        return cls(low, high, center, torch.where(bounded, half, torch.ones_like(half)))

    def clip(self, action: Tensor) -> Tensor:
        """Clip an action ``[*batch, m]``."""
        return action.clamp(self.low, self.high)

    def to_unit(self, action: Tensor) -> Tensor:
        """An action ``[*batch, m]`` in units of the half-range: the bounds become -1 and 1."""
        return (action - self.center) / self.scale

    def from_unit(self, action: Tensor) -> Tensor:
        """The inverse of :meth:`to_unit`."""
        return self.center + self.scale * action

    def to(self, device: torch.device | str) -> ActionBounds:
        """Return the same bounds on another device."""
        return ActionBounds(*(part.to(device) for part in self))


def read_limits(
    names: Sequence[str], low: Sequence[float] | None, high: Sequence[float]
) -> tuple[Limits, Limits]:
    """Return the lower and the upper bound of each action.

    Args:
        names: names of the actions.
        low: lower bounds; ``None`` for the negative of the upper ones.
        high: upper bounds.

    Raises:
        ConfigError: for bounds that are not finite, not in order, or not one for each action.

    Examples:
        >>> read_limits(["torque"], None, [2])
        ((-2.0,), (2.0,))
    """
    for key, given in (("action_high", high), ("action_low", low)):
        if given is None:
            continue
        if len(given) != len(names):
            raise ConfigError(key, f"expected {len(names)} values for {names}, got {given}.")
        if not all(math.isfinite(value) for value in given):
            raise ConfigError(key, f"expected finite bounds, got {given}.")
    upper = tuple(float(value) for value in high)
    if low is None and not all(value > 0 for value in upper):
        raise ConfigError(
            "action_high",
            f"expected positive bounds where action_low is not given, got {upper}.",
        )
    lower = tuple(-value for value in upper) if low is None else tuple(float(v) for v in low)
    if not all(a < b for a, b in zip(lower, upper, strict=True)):
        raise ConfigError("action_low", f"expected values below {upper}, got {lower}.")
    return lower, upper
