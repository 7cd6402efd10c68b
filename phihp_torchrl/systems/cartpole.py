"""A pole on a force-driven cart (paper, appendix B, equation 8; Barto et al., 1983)."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.systems.base import Constants, System


class CartPole(System):
    r"""A pole hinged on a driven cart (paper, equation 8); :math:`\theta = 0` is upright.

    .. math::
        \Sigma &= \frac{a + m_p l \dot\theta^2 \sin\theta}{m_c + m_p} \\
        \ddot\theta &= \frac{g\sin\theta - \Sigma\cos\theta}
            {l\,(4/3 - m_p\cos^2\theta / (m_c + m_p))} \\
        \ddot x &= \Sigma - \frac{m_p l \ddot\theta\cos\theta}{m_c + m_p}

    The constant ``half_length``, l, is half the length of the pole. Units: m, m/s, rad, rad/s, N,
    kg.

    Examples:
        >>> import torch
        >>> cart_pole = CartPole()  # upright at rest, it stays there
        >>> cart_pole.prior(torch.zeros(4), torch.zeros(1), cart_pole.constants)
        tensor([0., 0., 0., 0.])
    """

    state_names = ("x", "x_dot", "theta", "theta_dot")
    action_names = ("force",)
    angles = ("theta",)
    velocity_of = {"x": "x_dot", "theta": "theta_dot"}
    default_constants = {"gravity": 9.8, "cart_mass": 1.0, "pole_mass": 0.1, "half_length": 0.5}

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        _, x_dot, theta, theta_dot = state.unbind(-1)
        m_p, l = constants["pole_mass"], constants["half_length"]
        force = action[..., 0] + m_p * l * theta_dot.square() * theta.sin()
        x_ddot, theta_ddot = accelerations(
            theta, force, constants["gravity"] * theta.sin(), constants
        )
        return torch.stack([x_dot, x_ddot, theta_dot, theta_ddot], -1)

    def impulse(self, position: str, state: Tensor, constants: Constants) -> Tensor:
        """A stop of the cart swings the pole, and a stop of the pole drags the cart."""
        m_p, l = constants["pole_mass"], constants["half_length"]
        cos = state[..., 2].cos()
        one, zero = torch.ones_like(cos), torch.zeros_like(cos)
        if position == "x":
            return torch.stack([zero, one, zero, -0.75 * cos / l], -1)
        return torch.stack([zero, -m_p * l * cos / (constants["cart_mass"] + m_p), zero, one], -1)


def accelerations(
    theta: Tensor, force: Tensor, pull: Tensor, constants: Constants
) -> tuple[Tensor, Tensor]:
    """Return the accelerations of cart (m/s²) and pole (rad/s²), each ``[*batch]``.

    They are linear in ``force`` and ``pull``, so the contribution of friction can be added to them.

    Args:
        theta: angle of the pole, ``[*batch]``.
        force: force on the cart, N, ``[*batch]``.
        pull: acceleration of the pole across its own direction, m/s², ``[*batch]``.
        constants: ``cart_mass``, ``pole_mass`` and ``half_length``.
    """
    m_p, l = constants["pole_mass"], constants["half_length"]
    total = constants["cart_mass"] + m_p
    cos = theta.cos()
    sigma = force / total
    theta_ddot = (pull - cos * sigma) / (l * (4.0 / 3.0 - m_p * cos.square() / total))
    return sigma - m_p * l * theta_ddot * cos / total, theta_ddot
