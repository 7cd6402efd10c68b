"""A pole on a force-driven cart (paper, appendix B, equation 8; Barto et al., 1983)."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.systems.base import Constants, System


class CartPole(System):
    r"""A pole hinged on a cart; :math:`\theta = 0` is upright, ``half_length`` is half the pole.

    .. math::
        \Sigma &= \frac{a + m_p l \dot\theta^2 \sin\theta - Fr_c\,\mathrm{sgn}\,\dot x}
            {m_c + m_p} \\
        \ddot\theta &= \frac{g\sin\theta - \Sigma\cos\theta - Fr_p\dot\theta / (m_p l)}
            {l\,(4/3 - m_p\cos^2\theta / (m_c + m_p))} \\
        \ddot x &= \Sigma - \frac{m_p l \ddot\theta\cos\theta}{m_c + m_p}

    The terms in Fr are the friction; the accelerations are linear in them, so they separate
    exactly. Units: m, m/s, rad, rad/s, N, kg.
    """

    state_names = ("x", "x_dot", "theta", "theta_dot")
    action_names = ("force",)
    angles = ("theta",)
    velocity_of = {"x": "x_dot", "theta": "theta_dot"}
    default_constants = {"gravity": 9.8, "cart_mass": 1.0, "pole_mass": 0.1, "half_length": 0.5}
    default_friction = {"cart": 0.1, "pole": 0.02}

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        _, x_dot, theta, theta_dot = state.unbind(-1)
        m_p, l = constants["pole_mass"], constants["half_length"]
        force = action[..., 0] + m_p * l * theta_dot.square() * theta.sin()
        x_ddot, theta_ddot = _accelerations(
            theta, force, constants["gravity"] * theta.sin(), constants
        )
        return torch.stack([x_dot, x_ddot, theta_dot, theta_ddot], -1)

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        _, x_dot, theta, theta_dot = state.unbind(-1)
        m_p, l = self.constants["pole_mass"], self.constants["half_length"]
        force = -self.friction_constants["cart"] * x_dot.sign()
        pull = -self.friction_constants["pole"] * theta_dot / (m_p * l)
        x_ddot, theta_ddot = _accelerations(theta, force, pull, self.constants)
        zero = torch.zeros_like(x_dot)
        return torch.stack([zero, x_ddot, zero, theta_ddot], -1)


def _accelerations(
    theta: Tensor, force: Tensor, pull: Tensor, constants: Constants
) -> tuple[Tensor, Tensor]:
    """Accelerations of cart and pole; a force (N) acts on the cart, a pull (m/s²) on the pole."""
    m_p, l = constants["pole_mass"], constants["half_length"]
    total = constants["cart_mass"] + m_p
    cos = theta.cos()
    sigma = force / total
    theta_ddot = (pull - cos * sigma) / (l * (4.0 / 3.0 - m_p * cos.square() / total))
    return sigma - m_p * l * theta_ddot * cos / total, theta_ddot
