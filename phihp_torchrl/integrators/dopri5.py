"""Adaptive Dormand-Prince of order 5, from torchdiffeq."""

from __future__ import annotations

import torch
from torch import Tensor
from torchdiffeq import odeint

from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators.base import Derivative, Integrator, StateLayout, TimeStep


class Dopri5(Integrator):
    """Adaptive Dormand-Prince solver of order 5, for reference results rather than for speed.

    It chooses its inner steps by the largest error in the batch, so results depend on the rest of
    the batch, within the tolerances, and it does not compile as one graph. Limits of
    velocities and of positions are applied after the control step.

    Inner steps are never shorter than a hundredth of the control step: dry friction jumps where a
    velocity changes sign, and a cart that sticks there would need a hundred thousand inner steps.

    Args:
        rtol: relative tolerance of an inner step.
        atol: absolute tolerance of an inner step, in the units of the state.

    Raises:
        ConfigError: for tolerances that are not positive.
        ValueError: on a call, when any state of the batch
            is or becomes non-finite.

    Examples:
        >>> grow = Dopri5()(lambda s: s, torch.ones(1), 1.0, StateLayout(size=1))
        >>> round(grow.item(), 3)  # e is 2.718
        2.718
    """

    name = "dopri5"
    compiles = False

    def __init__(self, rtol: float = 1e-6, atol: float = 1e-8) -> None:
        if not (rtol > 0 and atol > 0):
            raise ConfigError("rtol, atol", f"expected positive tolerances, got {rtol}, {atol}.")
        self.rtol = rtol
        self.atol = atol

    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        # Time steps that differ are brought to the same unit interval by the speed of the motion.
        length, speed = (1.0, time_step) if isinstance(time_step, Tensor) else (time_step, 1.0)
        times = torch.tensor([0.0, length], dtype=state.dtype, device=state.device)
        try:
            trajectory = odeint(
                lambda _, s: speed * derivative(s),
                state,
                times,
                method="dopri5",
                rtol=self.rtol,
                atol=self.atol,
                options={"min_step": 0.01 * length},
            )
        except AssertionError as error:  # torchdiffeq raises these for non-finite values
            raise ValueError(f"state: expected finite values while solving; {error}.") from error
        return layout.clip(trajectory[-1])
