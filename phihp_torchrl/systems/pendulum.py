"""A torque-driven pendulum (paper, appendix B, equation 6)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.systems.base import Constants, System


class Pendulum(System):
    r"""A rod on a driven joint (paper, equation 6); :math:`\theta = 0` is upright.

    .. math:: \ddot\theta = \frac{3g}{2l}\sin\theta + \frac{3a}{ml^2}

    Units: rad, rad/s, N·m, kg, m.

    Examples:
        >>> pendulum = Pendulum()  # upright at rest, pushed with 1 N·m
        >>> pendulum.prior(torch.zeros(2), torch.ones(1), pendulum.constants)
        tensor([0., 3.])
    """

    state_names = ("theta", "theta_dot")
    action_names = ("torque",)
    angles = ("theta",)
    velocity_of = {"theta": "theta_dot"}
    default_constants = {"gravity": 10.0, "mass": 1.0, "length": 1.0}

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        theta, theta_dot = state.unbind(-1)
        c = self.identifiable(constants)
        theta_ddot = c["gravity_gain"] * theta.sin() + c["torque_gain"] * action[..., 0]
        return torch.stack([theta_dot, theta_ddot], -1)

    def identifiable(self, constants: Constants) -> dict[str, Any]:
        """The paper's C_g and C_i, which are all that the motion determines."""
        g, m, l = constants["gravity"], constants["mass"], constants["length"]
        return {"gravity_gain": 1.5 * g / l, "torque_gain": 3.0 / (m * l**2)}
