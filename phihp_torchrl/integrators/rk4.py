"""The classical fourth-order Runge-Kutta step."""

from __future__ import annotations

from torch import Tensor

from phihp_torchrl.integrators.base import Derivative, Integrator, StateLayout


class RK4(Integrator):
    """Classical Runge-Kutta of order 4; velocity limits apply after the step."""

    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: float, layout: StateLayout
    ) -> Tensor:
        half = 0.5 * time_step
        k1 = derivative(state)
        k2 = derivative(state + half * k1)
        k3 = derivative(state + half * k2)
        k4 = derivative(state + time_step * k3)
        return layout.clip(state + time_step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4))
