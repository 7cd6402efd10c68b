"""Semi-implicit Euler: velocities first, then positions with the new velocities."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from phihp_torchrl.integrators.base import Derivative, Integrator, StateLayout


class SemiImplicitEuler(Integrator):
    r"""The integrator of the published runs; first order, and kind to energy.

    .. math::
        v' = \mathrm{clip}(v + \Delta t\, f_v(q, v)), \qquad
        q' = q + \Delta t\, (f_q(q, v) + v' - v)

    With the kinematics :math:`f_q = v` this is the textbook scheme. Written this way it asks for
    one evaluation of ``f`` and holds anything learned on top of :math:`f_q` over the step.
    First-order components take an explicit Euler step.
    """

    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: float, layout: StateLayout
    ) -> Tensor:
        old = state.unbind(-1)
        rate = derivative(state).unbind(-1)
        new = [s + time_step * r for s, r in zip(old, rate, strict=True)]
        for (q, v), limit in zip(layout.pairs, layout.limits, strict=True):
            if math.isfinite(limit):
                new[v] = new[v].clamp(-limit, limit)
            new[q] = old[q] + time_step * (rate[q] + new[v] - old[v])
        return torch.stack(new, -1)
