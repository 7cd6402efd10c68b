"""Adaptive Dormand-Prince of order 5, from torchdiffeq."""

from __future__ import annotations

import torch
from torch import Tensor
from torchdiffeq import odeint

from phihp_torchrl.integrators.base import Derivative, Integrator, StateLayout


class Dopri5(Integrator):
    """Adaptive reference solver, for accuracy rather than speed.

    It chooses its inner steps by the worst error in the batch, so results depend on the batch
    within the tolerances, and it never compiles as one graph. Velocity limits apply after the step.

    Inner steps are never shorter than a hundredth of the step: dry friction jumps where a velocity
    changes sign, and a cart that sticks there would ask for a hundred thousand of them.

    Args:
        rtol: relative tolerance of an inner step.
        atol: absolute tolerance of an inner step, in the units of the state.

    Raises:
        ValueError: for tolerances that are not positive, and on a call when any state of the batch
            is or becomes non-finite.
    """

    compiles = False

    def __init__(self, rtol: float = 1e-6, atol: float = 1e-8) -> None:
        if not (rtol > 0 and atol > 0):
            raise ValueError(f"rtol, atol: expected positive tolerances, got {rtol}, {atol}.")
        self.rtol = rtol
        self.atol = atol

    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: float, layout: StateLayout
    ) -> Tensor:
        times = torch.tensor([0.0, time_step], dtype=state.dtype, device=state.device)
        try:
            trajectory = odeint(
                lambda _, s: derivative(s),
                state,
                times,
                method="dopri5",
                rtol=self.rtol,
                atol=self.atol,
                options={"min_step": 0.01 * time_step},
            )
        except AssertionError as error:  # torchdiffeq's way to say so
            raise ValueError(f"state: expected finite values while solving; {error}.") from error
        return layout.clip(trajectory[-1])
