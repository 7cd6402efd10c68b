"""Adaptive Dormand-Prince of order 5, from torchdiffeq."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.config import check_positive
from phihp_torchrl.integrators.base import Derivative, Integrator, StateLayout, TimeStep

_BOUND = 1e15
"""Beyond it, in any unit, a state or its rate of change has run away."""


class Dopri5(Integrator):
    """Adaptive Dormand-Prince solver of order 5, for reference results rather than for speed.

    It chooses its inner steps by the largest error in the batch, so results depend on the rest of
    the batch, within the tolerances, and it does not compile as one graph. Limits of
    velocities and of positions are applied after the control step.

    Inner steps are never shorter than a hundredth of the control step: dry friction jumps where a
    velocity changes sign, and a cart that sticks there would need a hundred thousand inner steps.

    A state that is not finite, or that runs away beyond 1e15 or at a rate beyond it, becomes NaN
    and leaves the rest of the batch alone, so that a planner's candidate that diverges loses.

    Args:
        rtol: relative tolerance of an inner step.
        atol: absolute tolerance of an inner step, in the units of the state.

    Raises:
        ConfigError: for tolerances that are not positive.

    Examples:
        >>> grow = Dopri5()(lambda s: s, torch.ones(1), 1.0, StateLayout(size=1))
        >>> round(grow.item(), 3)  # e is 2.718
        2.718
    """

    name = "dopri5"
    compiles = False

    def __init__(self, rtol: float = 1e-6, atol: float = 1e-8) -> None:
        self.rtol = rtol
        self.atol = atol
        check_positive(self, "rtol", "atol")

    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        from torchdiffeq import odeint  # here, for it imports much of SciPy, and few solve by it

        # Time steps that differ are brought to the same unit interval by the speed of the motion.
        length, speed = (1.0, time_step) if isinstance(time_step, Tensor) else (time_step, 1.0)
        times = torch.tensor([0.0, length], dtype=state.dtype, device=state.device)
        # torchdiffeq refuses the whole batch for one value that is not finite, so a state that runs
        # away stands still from there on.
        lost = ~_is_bounded(state)

        def bounded(_: Tensor, s: Tensor) -> Tensor:
            nonlocal lost
            rate = speed * derivative(s)
            lost = lost | ~(_is_bounded(s) & _is_bounded(rate))
            return torch.where(lost, torch.zeros_like(rate), rate)

        trajectory = odeint(
            bounded,
            torch.where(lost, torch.zeros_like(state), state),
            times,
            method="dopri5",
            rtol=self.rtol,
            atol=self.atol,
            options={"min_step": 0.01 * length},
        )
        return layout.clip(trajectory[-1]).masked_fill(lost, torch.nan)


def _is_bounded(values: Tensor) -> Tensor:
    """Whether all components of each row are finite and below the bound, ``[*batch, 1]``."""
    return (values.abs() <= _BOUND).all(-1, keepdim=True)
