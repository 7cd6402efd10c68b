"""Semi-implicit Euler: velocities first, then positions with the new velocities."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from phihp_torchrl.integrators.base import (
    Derivative,
    FixedStepIntegrator,
    Solver,
    StateLayout,
    TimeStep,
)


class SemiImplicitEuler(FixedStepIntegrator):
    r"""The integrator of the published runs: of first order, with little drift of the energy.

    .. math::
        v' = \mathrm{clip}(v + \Delta t\, f_v(q, v)), \qquad
        q' = q + \Delta t\, (f_q(q, v) + v' - v)

    With the kinematics :math:`f_q = v` this is the textbook scheme. In this form it needs one
    evaluation of ``f``, and holds over the step whatever a model adds to :math:`f_q`. Components
    without a velocity take an explicit Euler step. Stops act after each step.

    Args:
        substeps: solver steps in a control step.

    Examples:
        >>> fall = SemiImplicitEuler()
        >>> layout = StateLayout(size=2, pairs=((0, 1),), limits=(float("inf"),))
        >>> fall(lambda s: torch.stack([s[1], -torch.ones(())]), torch.zeros(2), 0.5, layout)
        tensor([-0.2500, -0.5000])
    """

    name = "semi_implicit_euler"

    def step(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        if isinstance(time_step, Tensor):
            time_step = time_step.expand(*state.shape[:-1], 1)[..., 0]  # that of one component
        old = state.unbind(-1)
        rate = derivative(state).unbind(-1)
        new = [s + time_step * r for s, r in zip(old, rate, strict=True)]
        for (q, v), (low, high) in zip(layout.pairs, layout.limits, strict=True):
            if math.isfinite(low) or math.isfinite(high):
                new[v] = new[v].clamp(low, high)
            new[q] = old[q] + time_step * (rate[q] + new[v] - old[v])
        return layout.stop(torch.stack(new, -1))

    def prepared(self, time_step: float, layout: StateLayout, like: Tensor) -> Solver:
        """The step on whole states: one product takes all velocities' changes to positions."""
        seconds = time_step / self.substeps
        low, high = [-math.inf] * layout.size, [math.inf] * layout.size
        carry = [[0.0] * layout.size for _ in range(layout.size)]
        for (q, v), limits in zip(layout.pairs, layout.limits, strict=True):
            low[v], high[v] = limits
            carry[v][q] = seconds
        bounds = (like.new_tensor(low), like.new_tensor(high)) if layout.limited else None
        to_positions = like.new_tensor(carry)

        def solve(derivative: Derivative, state: Tensor) -> Tensor:
            for _ in range(self.substeps):
                new = torch.add(state, derivative(state), alpha=seconds)
                if bounds is not None:
                    new = new.clamp(*bounds)
                state = layout.stop(torch.addmm(new, new - state, to_positions))
            return state

        return solve
