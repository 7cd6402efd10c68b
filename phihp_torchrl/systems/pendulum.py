"""A torque-driven pendulum (paper, appendix B, equation 6)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.systems.base import Constants, System


class Pendulum(System):
    r"""A rod on a driven joint; :math:`\theta = 0` is upright.

    .. math::
        \ddot\theta = \frac{3g}{2l}\sin\theta + \frac{3a}{ml^2} - \frac{\eta\dot\theta}{ml^2}

    The last term is the friction. Units: rad, rad/s, N·m, kg, m.
    """

    state_names = ("theta", "theta_dot")
    action_names = ("torque",)
    angles = ("theta",)
    velocity_of = {"theta": "theta_dot"}
    default_constants = {"gravity": 10.0, "mass": 1.0, "length": 1.0}
    default_friction = {"joint": 0.5}

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        theta, theta_dot = state.unbind(-1)
        c = self.identifiable(constants)
        theta_ddot = c["gravity_gain"] * theta.sin() + c["torque_gain"] * action[..., 0]
        return torch.stack([theta_dot, theta_ddot], -1)

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        theta_dot = state[..., 1]
        inertia = self.constants["mass"] * self.constants["length"] ** 2
        slowdown = -self.friction_constants["joint"] * theta_dot / inertia
        return torch.stack([torch.zeros_like(theta_dot), slowdown], -1)

    def identifiable(self, constants: Constants) -> dict[str, Any]:
        """The paper's C_g and C_i: only these two can be told from the motion."""
        g, m, l = constants["gravity"], constants["mass"], constants["length"]
        return {"gravity_gain": 1.5 * g / l, "torque_gain": 3.0 / (m * l**2)}
