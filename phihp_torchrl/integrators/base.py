"""What every integrator receives and promises."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Derivative = Callable[[Tensor], Tensor]
"""A vector field ``state [*batch, n] -> ds/dt [*batch, n]`` with the action held inside."""


@dataclass(frozen=True)
class StateLayout:
    """Which components of a state are positions and velocities, and how fast the latter may be.

    Args:
        size: number of state components, ``n``.
        pairs: ``(position, velocity)`` index pairs. Components in no pair are first-order.
        limits: one bound on ``|velocity|`` per pair, in the velocity's own unit; ``inf`` for none.

    Examples:
        >>> StateLayout(size=2, pairs=((0, 1),), limits=(8.0,)).limited
        True
    """

    size: int
    pairs: tuple[tuple[int, int], ...] = ()
    limits: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.limits) != len(self.pairs):
            raise ValueError(
                f"limits: expected one per (position, velocity) pair, {len(self.pairs)}, "
                f"got {len(self.limits)}."
            )
        if any(not limit > 0 for limit in self.limits):
            raise ValueError(f"limits: expected positive velocity limits, got {self.limits}.")

    @property
    def limited(self) -> bool:
        """Whether any velocity has a finite limit."""
        return any(math.isfinite(limit) for limit in self.limits)

    def clip(self, state: Tensor) -> Tensor:
        """Clip the velocities of ``state`` ``[*batch, n]`` to their limits."""
        if not self.limited:
            return state
        components = list(state.unbind(-1))
        for (_, velocity), limit in zip(self.pairs, self.limits, strict=True):
            if math.isfinite(limit):
                components[velocity] = components[velocity].clamp(-limit, limit)
        return torch.stack(components, -1)


class Integrator(abc.ABC):
    """Solve ds/dt = f(s) over one control step (paper, equation 2).

    Integrators hold no tensors and no state, so one instance serves every device and dtype.
    """

    compiles: bool = True
    """Whether ``torch.compile(fullgraph=True)`` accepts a step."""

    @abc.abstractmethod
    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: float, layout: StateLayout
    ) -> Tensor:
        """Return the state ``time_step`` seconds after ``state`` ``[*batch, n]``, same shape."""
