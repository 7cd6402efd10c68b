"""A two-link arm that hangs from a hinge (paper, appendix B, equation 7; Sutton, 1996)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from phihp_torchrl.systems.base import Constants, System


class Acrobot(System):
    r"""A two-link arm, both joints driven (paper, equation 7); it hangs at :math:`\theta = 0`.

    .. math:: M(q)\,\ddot q + c(q, \dot q) = \tau

    Without torque on the first joint these are gymnasium's Acrobot equations in their ``book``
    form. Units: rad, rad/s, N·m, kg, m, kg·m².

    Examples:
        >>> import torch
        >>> acrobot = Acrobot()  # hanging down at rest, it stays there
        >>> acrobot.prior(torch.zeros(4), torch.zeros(2), acrobot.constants).abs().max()
        tensor(0.)
    """

    state_names = ("theta1", "theta2", "theta1_dot", "theta2_dot")
    action_names: ClassVar[tuple[str, ...]] = ("torque1", "torque2")
    angles = ("theta1", "theta2")
    velocity_of = {"theta1": "theta1_dot", "theta2": "theta2_dot"}
    default_constants = {
        "gravity": 9.8,
        "mass1": 1.0,
        "mass2": 1.0,
        "length1": 1.0,
        "center1": 0.5,
        "center2": 0.5,
        "inertia1": 1.0,
        "inertia2": 1.0,
    }

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        theta1, theta2, omega1, omega2 = state.unbind(-1)
        torque1, torque2 = self.torques(action)
        c = self.identifiable(constants)
        sin2 = theta2.sin()
        pull2 = c["weight2"] * (theta1 + theta2).sin()
        pull1 = c["weight1"] * theta1.sin() + pull2
        swirl = c["coupling"] * sin2
        rest1 = torque1 - pull1 + swirl * omega2 * (omega2 + 2.0 * omega1)
        rest2 = torque2 - pull2 - swirl * omega1.square()
        alpha1, alpha2 = solve_inertia(theta2, rest1, rest2, c)
        return torch.stack([omega1, omega2, alpha1, alpha2], -1)

    def impulse(self, position: str, state: Tensor, constants: Constants) -> Tensor:
        """A stop of one joint swings the other link."""
        one, zero = torch.ones_like(state[..., 0]), torch.zeros_like(state[..., 0])
        first = position == "theta1"
        blow = (one, zero) if first else (zero, one)
        change = solve_inertia(state[..., 1], *blow, self.identifiable(constants))
        own = change[0] if first else change[1]
        return torch.stack([zero, zero, change[0] / own, change[1] / own], -1)

    def torques(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Torques on both joints for an action ``[*batch, m]``."""
        return action[..., 0], action[..., 1]

    def identifiable(self, constants: Constants) -> dict[str, Any]:
        """The five base parameters of a two-link arm, which are all that its motion determines."""
        m1, m2, l1 = constants["mass1"], constants["mass2"], constants["length1"]
        lc1, lc2, g = constants["center1"], constants["center2"], constants["gravity"]
        return {
            "inertia_a": m1 * lc1**2 + m2 * l1**2 + constants["inertia1"],
            "inertia_b": m2 * lc2**2 + constants["inertia2"],
            "coupling": m2 * l1 * lc2,
            "weight1": g * (m1 * lc1 + m2 * l1),
            "weight2": g * m2 * lc2,
        }


class ElbowAcrobot(Acrobot):
    """The classic Acrobot: only the second joint, the elbow, is driven (paper, appendix B).

    Examples:
        >>> ElbowAcrobot().action_dim
        1
    """

    action_names = ("torque2",)

    def torques(self, action: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(action[..., 0]), action[..., 0]


def solve_inertia(
    theta2: Tensor, rest1: Tensor, rest2: Tensor, base: dict[str, Any]
) -> tuple[Tensor, Tensor]:
    """Solve M(q) x = rest for the symmetric 2x2 inertia matrix M(q) of the arm.

    Args:
        theta2: angle of the second joint, ``[*batch]``.
        rest1: right side of the first equation, N·m, ``[*batch]``.
        rest2: right side of the second equation, N·m, ``[*batch]``.
        base: the base parameters, as :meth:`Acrobot.identifiable` returns them.

    Returns:
        Both components of x, rad/s², each ``[*batch]``.
    """
    coupled = base["coupling"] * theta2.cos()
    m11 = base["inertia_a"] + base["inertia_b"] + 2.0 * coupled
    m12 = base["inertia_b"] + coupled
    m22 = base["inertia_b"]
    determinant = m11 * m22 - m12 * m12
    return (m22 * rest1 - m12 * rest2) / determinant, (m11 * rest2 - m12 * rest1) / determinant
