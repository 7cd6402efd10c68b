"""Random trajectories of references and inputs: steps, ramps and sines in turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_not_negative, check_positive


class Sampler(Protocol):
    """The interface of everything that draws trajectories of a signal, such as a user's function.

    Examples:
        >>> def telegraph(shape, steps, time_step, generator=None):  # -1 or 1, from step to step
        ...     return 2.0 * torch.randint(2, [*shape, steps, 1], generator=generator) - 1.0
        >>> telegraph([8], steps=50, time_step=0.02).shape
        torch.Size([8, 50, 1])
    """

    def __call__(
        self,
        shape: Sequence[int],
        steps: int,
        time_step: float,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw trajectories ``[*shape, steps, k]`` in physical units, on the generator's device."""


@dataclass(frozen=True)
class Trajectories:
    """Trajectories that are pieced together from steps, ramps and sines of random length.

    A new piece begins at random, after ``hold`` seconds on average. A *step* jumps to a value drawn
    uniformly from the range and stays there, a *ramp* moves to one at a constant rate, and a *sine*
    swings about a value, within the range, with a period of 0.5 to 2 times ``period``. The shares
    are chances of a piece to be of each kind; they are divided by their sum. All components of a
    signal have pieces of their own.

    Args:
        hold: mean duration of a piece, in seconds.
        steps: share of steps.
        ramps: share of ramps.
        sines: share of sines.
        period: typical period of a sine, in seconds. Defaults to ``hold``.

    Raises:
        ConfigError: for a duration that is not positive, a negative share, or no positive one.

    Examples:
        >>> trajectories = Trajectories(hold=0.5, ramps=0.0, sines=0.0)
        >>> drawn = trajectories([3], steps=200, time_step=0.01, low=(-1.0,), high=(2.0,))
        >>> drawn.shape, bool((drawn >= -1.0).all() and (drawn <= 2.0).all())
        (torch.Size([3, 200, 1]), True)
    """

    hold: float = 1.0
    steps: float = 0.5
    ramps: float = 0.25
    sines: float = 0.25
    period: float | None = None

    def __post_init__(self) -> None:
        check_positive(self, "hold")
        check_not_negative(self, "steps", "ramps", "sines")
        if self.period is not None:
            check_positive(self, "period")
        if not self.steps + self.ramps + self.sines > 0:
            raise ConfigError("steps", f"expected a share of some kind above 0, got {self}.")

    def __call__(
        self,
        shape: Sequence[int],
        steps: int,
        time_step: float,
        generator: torch.Generator | None = None,
        *,
        low: Sequence[float],
        high: Sequence[float],
    ) -> Tensor:
        """Draw trajectories ``[*shape, steps, k]``, float32, on the device of the generator.

        Args:
            shape: leading dimensions.
            steps: number of values in a trajectory.
            time_step: seconds from one value to the next.
            generator: source of randomness.
            low: smallest value of each component, ``[k]``.
            high: largest value of each component, ``[k]``.
        """
        device = torch.device("cpu") if generator is None else generator.device
        size = (*shape, steps, len(low))
        bottom, top = (torch.tensor(tuple(end), device=device) for end in (low, high))

        def uniform() -> Tensor:
            return torch.rand(size, generator=generator, device=device)

        # A piece is described by what was drawn at its first step.
        begins = uniform() < -math.expm1(-time_step / self.hold)
        begins[..., :1, :] = True
        at = torch.arange(steps, device=device).unsqueeze(-1).expand(size)
        first = torch.where(begins, at, 0).cummax(-2).values
        value = bottom + (top - bottom) * uniform()
        target = value.gather(-2, first)
        # The value to which the piece before was drawn; the first piece has none and starts at its
        # own.
        before = value.gather(-2, first.gather(-2, (first - 1).clamp_min(0)))
        kind = uniform().gather(-2, first)
        age = (at - first).to(value.dtype)
        following = torch.where(begins, at, steps).flip(-2).cummin(-2).values.flip(-2)
        end = torch.cat([following[..., 1:, :], torch.full_like(following[..., :1, :], steps)], -2)
        ramp = before + (target - before) * age / (end - first).to(value.dtype)
        reach = torch.minimum(target - bottom, top - target) * uniform().gather(-2, first)
        seconds = (self.period or self.hold) * torch.exp2(2.0 * uniform() - 1.0)
        phase = 2.0 * math.pi * (age * time_step / seconds.gather(-2, first))
        sine = target + reach * phase.sin()
        total = self.steps + self.ramps + self.sines
        moved = torch.where(kind < (self.steps + self.ramps) / total, ramp, sine)
        return torch.where(kind < self.steps / total, target, moved)
