"""The plants of the paper's systems, with their friction (paper, appendix B)."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from phihp_torchrl.systems import Acrobot, CartPole, Pendulum, accelerations, solve_inertia
from phihp_torchrl.worlds.simulated.plant import Plant, register_plant


class PendulumPlant(Plant):
    r"""A pendulum with viscous friction on its joint, in N·m·s (paper, equation 6).

    .. math:: F^r_{\dot\theta} = -\frac{\eta\,\dot\theta}{m l^2}
    """

    default_coefficients = {"joint": 0.5}

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        theta_dot = state[..., 1]
        inertia = self.constants["mass"] * self.constants["length"] ** 2
        slowdown = -self.coefficients["joint"] * theta_dot / inertia
        return torch.stack([torch.zeros_like(theta_dot), slowdown], -1)


class CartPolePlant(Plant):
    r"""A cart with dry friction on its rail and a viscous pole, N and N·m·s (paper, equation 8).

    The force :math:`-Fr_c\,\mathrm{sgn}\,\dot x` acts on the cart, the pull
    :math:`-Fr_p\,\dot\theta / (m_p l)` on the pole; accelerations are linear in both.
    """

    default_coefficients = {"cart": 0.1, "pole": 0.02}

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        _, x_dot, theta, theta_dot = state.unbind(-1)
        m_p, l = self.constants["pole_mass"], self.constants["half_length"]
        force = -self.coefficients["cart"] * x_dot.sign()
        pull = -self.coefficients["pole"] * theta_dot / (m_p * l)
        x_ddot, theta_ddot = accelerations(theta, force, pull, self.constants)
        zero = torch.zeros_like(x_dot)
        return torch.stack([zero, x_ddot, zero, theta_ddot], -1)


class AcrobotPlant(Plant):
    r"""An arm with viscous friction on both joints, in N·m·s (paper, equation 7).

    .. math:: M(q)\,\ddot q + c(q, \dot q) = \tau - \mathrm{diag}(b)\,\dot q

    The paper prints the opposite sign for the first joint, which would accelerate it.
    """

    default_coefficients = {"joint1": 0.01, "joint2": 0.05}

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        _, theta2, omega1, omega2 = state.unbind(-1)
        alpha1, alpha2 = solve_inertia(
            theta2,
            -self.coefficients["joint1"] * omega1,
            -self.coefficients["joint2"] * omega2,
            cast(Acrobot, self.system).identifiable(self.constants),
        )
        zero = torch.zeros_like(omega1)
        return torch.stack([zero, zero, alpha1, alpha2], -1)


register_plant(Pendulum, PendulumPlant)
register_plant(CartPole, CartPolePlant)
register_plant(Acrobot, AcrobotPlant)
