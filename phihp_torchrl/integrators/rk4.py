"""The classical fourth-order Runge-Kutta step."""

from __future__ import annotations

from torch import Tensor

from phihp_torchrl.integrators.base import Derivative, FixedStepIntegrator, StateLayout, TimeStep


class RK4(FixedStepIntegrator):
    r"""Classical Runge-Kutta method of order 4; limits are applied after each step.

    .. math:: s' = s + \tfrac{\Delta t}{6} (k_1 + 2 k_2 + 2 k_3 + k_4)

    Args:
        substeps: solver steps in a control step.

    Examples:
        >>> import torch
        >>> grow = RK4(substeps=4)(lambda s: s, torch.ones(1), 1.0, StateLayout(size=1))
        >>> round(grow.item(), 3)  # e is 2.718
        2.718
    """

    name = "rk4"

    def step(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        half = 0.5 * time_step
        k1 = derivative(state)
        k2 = derivative(state + half * k1)
        k3 = derivative(state + half * k2)
        k4 = derivative(state + time_step * k3)
        return layout.clip(state + time_step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4))
