r"""Friction and stops, as terms of a prior: forces that a user adds where they act.

Each function takes tensors in a :meth:`System.prior`, and SymPy's expressions in the
:meth:`~phihp_torchrl.systems.LagrangianSystem.forces` of a Lagrangian. Coefficients may be
constants of the system, which are then learned. All of them are continuous, and differentiable but
for the kinks of :func:`stop`.

Examples:
    >>> import torch
    >>> velocity = torch.tensor([-1.0, 0.0, 2.0])
    >>> viscous(velocity, 0.5) + coulomb(velocity, 0.1, width=0.01)
    tensor([ 0.6000, -0.0000, -1.1000])
"""

from __future__ import annotations

from typing import Any

import sympy
import torch

Value = Any
"""A tensor ``[*batch]``, a number, or an expression of SymPy."""


def viscous(velocity: Value, coefficient: Value) -> Value:
    """Friction in proportion to the velocity, as of oil: ``-coefficient * velocity``.

    Args:
        velocity: m/s or rad/s, ``[*batch]``.
        coefficient: N·s/m or N·m·s/rad.

    Returns:
        The force in N or the torque in N·m, ``[*batch]``.

    Examples:
        >>> viscous(torch.tensor([2.0, -1.0]), 0.5)
        tensor([-1.0000,  0.5000])
    """
    return -coefficient * velocity


def coulomb(velocity: Value, coefficient: Value, width: Value = 0.01) -> Value:
    r"""Dry friction of one size against the motion: ``-coefficient * tanh(velocity / width)``.

    True dry friction jumps where the velocity changes sign, which no gradient and no fit can
    follow. Here it passes from one side to the other over a few widths. An explicit integrator
    needs steps shorter than about ``2 * mass * width / coefficient`` to hold still at rest.

    Args:
        velocity: m/s or rad/s, ``[*batch]``.
        coefficient: the size of the force in N, or of the torque in N·m.
        width: velocity at which 76 % of the friction has come; positive.

    Returns:
        The force in N or the torque in N·m, ``[*batch]``.

    Examples:
        >>> coulomb(torch.tensor([2.0, -1.0, 0.0]), 0.5, width=0.1)
        tensor([-0.5000,  0.5000, -0.0000])
    """
    ratio = velocity / width
    return -coefficient * (sympy.tanh(ratio) if _symbolic(ratio) else torch.tanh(ratio))


def stop(
    position: Value, velocity: Value, low: Value, high: Value, stiffness: Value, damping: Value
) -> Value:
    r"""Elastic stops at both ends of a range, nothing between them.

    Behind an end, with depth :math:`d \ge 0` and :math:`\dot d` the velocity into it, the force
    back is :math:`\max(0,\; k\,d + c\,d\,\dot d)` (Hunt and Crossley, 1975,
    https://doi.org/10.1115/1.3423596). It grows from 0 with the depth and never pulls. A step
    has to be short against ``sqrt(mass / stiffness)``; for stops that are hard against the
    time step, give the task ``position_limits`` instead.

    Args:
        position: m or rad, ``[*batch]``.
        velocity: m/s or rad/s, ``[*batch]``.
        low: lower end of the range.
        high: upper end of the range, above ``low``.
        stiffness: k in N/m or N·m/rad.
        damping: c in N·s/m² or N·m·s/rad²; 0 gives all energy back.

    Returns:
        The force in N or the torque in N·m, ``[*batch]``.

    Examples:
        >>> position = torch.tensor([-1.5, 0.0, 1.5])
        >>> stop(position, torch.zeros(3), -1.0, 1.0, stiffness=100.0, damping=10.0)
        tensor([ 50.,   0., -50.])
    """
    below, above = _positive(low - position), _positive(position - high)
    return _positive(below * (stiffness - damping * velocity)) - _positive(
        above * (stiffness + damping * velocity)
    )


def soft_stop(
    acceleration: Value,
    position: Value,
    velocity: Value,
    low: Value,
    high: Value,
    stiffness: Value,
    damping: Value,
    share: Value = 1.0,
) -> Value:
    r"""What soft stops at both ends of a range add to an acceleration, nothing between them.

    Physics engines stop joints by a constraint and not by a spring: behind an end, with depth
    :math:`d \ge 0`, velocity :math:`\dot d` and acceleration a into it, the stop replaces a share
    s of the acceleration by a return to the end, and never pulls:

    .. math:: \ddot d = a - \max(0,\; s\,(a + c\,\dot d + k\,d))

    These are MuJoCo's limits of joints (Todorov, 2014; Baumgarte, 1972), with k and c from
    ``solreflimit`` and s, close to 1, from ``solimplimit``. A stop that acts on other velocities
    too adds its change times :meth:`System.impulse`:

    .. code-block:: python

        rate = super().prior(state, action, constants)
        held = soft_stop(rate[..., 1], state[..., 0], state[..., 1], -1.8, 1.8, 150.0, 25.0)
        rate = rate + held.unsqueeze(-1) * self.impulse("x", state, constants)

    Args:
        acceleration: acceleration without the stop, m/s² or rad/s², ``[*batch]``.
        position: m or rad, ``[*batch]``.
        velocity: m/s or rad/s, ``[*batch]``.
        low: lower end of the range.
        high: upper end of the range, above ``low``.
        stiffness: k in 1/s², ``1 / (timeconst * dampratio)**2`` in MuJoCo's words.
        damping: c in 1/s, ``2 / timeconst`` in MuJoCo's words.
        share: s in (0, 1], the share of the acceleration that the stop holds.

    Returns:
        The change of the acceleration, ``[*batch]``.

    Examples:
        >>> push, position = torch.tensor([2.0, 2.0, 2.0]), torch.tensor([0.0, 1.5, -1.5])
        >>> soft_stop(push, position, torch.zeros(3), -1.0, 1.0, stiffness=100.0, damping=20.0)
        tensor([  0., -52.,  48.])
    """
    below, above = low - position, position - high
    back_down = _positive(share * (acceleration + damping * velocity + stiffness * above))
    back_up = _positive(share * (-acceleration - damping * velocity + stiffness * below))
    return back_up * _step(below) - back_down * _step(above)


def _positive(value: Value) -> Value:
    """The larger of ``value`` and 0."""
    return sympy.Max(value, 0) if _symbolic(value) else value.clamp_min(0.0)


def _step(value: Value) -> Value:
    """1 where ``value`` is positive, and 0 elsewhere."""
    if _symbolic(value):
        return sympy.Heaviside(value, 0)
    return (value > 0).to(value.dtype)


def _symbolic(value: Value) -> bool:
    return isinstance(value, sympy.Basic)
