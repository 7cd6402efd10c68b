"""Two poles, one on the other, on a force-driven cart: a system from its Lagrangian."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy

from phihp_torchrl.systems.lagrangian import LagrangianSystem, Symbols


class CartDoublePendulum(LagrangianSystem):
    """Two uniform rods, the second hinged at the end of the first, on a driven cart.

    Both angles are measured from upright, so that all is upright at 0; the second one is not
    relative to the first. Units: m, m/s, rad, rad/s, N, kg.

    Examples:
        >>> import torch
        >>> double = CartDoublePendulum()  # upright at rest, it stays there
        >>> double.prior(torch.zeros(6), torch.zeros(1), double.constants).abs().max()
        tensor(0.)
    """

    state_names = ("x", "theta1", "theta2", "x_dot", "theta1_dot", "theta2_dot")
    action_names = ("force",)
    angles = ("theta1", "theta2")
    velocity_of = {"x": "x_dot", "theta1": "theta1_dot", "theta2": "theta2_dot"}
    default_constants = {
        "gravity": 9.81,
        "cart_mass": 1.0,
        "mass1": 0.2,
        "mass2": 0.2,
        "length1": 0.5,
        "length2": 0.5,
    }

    def lagrangian(self, state: Symbols, constants: Mapping[str, sympy.Symbol]) -> sympy.Expr:
        _, theta1, theta2, x_dot, theta1_dot, theta2_dot = state
        c = constants
        across, up = x_dot, sympy.Integer(0)  # velocity of the hinge that a rod hangs on
        energy, height = c["cart_mass"] * x_dot**2 / 2, sympy.Integer(0)
        rods = ((1, theta1, theta1_dot), (2, theta2, theta2_dot))
        for i, theta, theta_dot in rods:
            mass, length = c[f"mass{i}"], c[f"length{i}"]
            run, rise = (
                length * theta_dot * sympy.cos(theta),
                -length * theta_dot * sympy.sin(theta),
            )
            speed2 = (across + run / 2) ** 2 + (up + rise / 2) ** 2
            spin2 = length**2 / 12 * theta_dot**2
            energy += mass * (speed2 + spin2) / 2
            energy -= mass * c["gravity"] * (height + length * sympy.cos(theta) / 2)
            across, up, height = across + run, up + rise, height + length * sympy.cos(theta)
        return energy

    def forces(
        self, state: Symbols, action: Symbols, constants: Mapping[str, sympy.Symbol]
    ) -> Mapping[str, Any]:
        return {"x": action[0]}
