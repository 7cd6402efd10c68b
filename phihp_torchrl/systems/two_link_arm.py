"""A two-link arm with a load in its hand: a system from its Lagrangian, with friction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy

from phihp_torchrl.systems.lagrangian import LagrangianSystem, Symbols
from phihp_torchrl.systems.terms import viscous


class TwoLinkArm(LagrangianSystem):
    """Two uniform rods with driven joints, in a vertical plane, with a point load at the end.

    The arm hangs at 0; the second angle is relative to the first rod. Both joints have viscous
    friction, whose coefficients are learned with the other constants. Units: rad, rad/s, N·m, kg,
    m, N·m·s/rad.

    Examples:
        >>> import torch
        >>> arm = TwoLinkArm()  # hanging down at rest, it stays there
        >>> arm.prior(torch.zeros(4), torch.zeros(2), arm.constants).abs().max()
        tensor(0.)
    """

    state_names = ("shoulder", "elbow", "shoulder_dot", "elbow_dot")
    action_names = ("shoulder_torque", "elbow_torque")
    angles = ("shoulder", "elbow")
    velocity_of = {"shoulder": "shoulder_dot", "elbow": "elbow_dot"}
    default_constants = {
        "gravity": 9.81,
        "mass1": 1.0,
        "mass2": 0.8,
        "load": 0.3,
        "length1": 0.4,
        "length2": 0.3,
        "friction1": 0.05,
        "friction2": 0.05,
    }

    def lagrangian(self, state: Symbols, constants: Mapping[str, sympy.Symbol]) -> sympy.Expr:
        shoulder, elbow, shoulder_dot, elbow_dot = state
        c = constants
        total, spin = shoulder + elbow, shoulder_dot + elbow_dot
        l1, l2 = c["length1"], c["length2"]

        def body(mass: sympy.Expr, reach: sympy.Expr) -> sympy.Expr:
            """Kinetic minus potential energy of a mass at ``reach`` along the second rod."""
            across = l1 * sympy.cos(shoulder) * shoulder_dot + reach * sympy.cos(total) * spin
            up = l1 * sympy.sin(shoulder) * shoulder_dot + reach * sympy.sin(total) * spin
            height = -l1 * sympy.cos(shoulder) - reach * sympy.cos(total)
            return mass * ((across**2 + up**2) / 2 - c["gravity"] * height)

        upper = (
            c["mass1"] * l1 * (l1 * shoulder_dot**2 / 6 + c["gravity"] * sympy.cos(shoulder) / 2)
        )
        turning = c["mass2"] * l2**2 / 12 * spin**2 / 2
        return upper + turning + body(c["mass2"], l2 / 2) + body(c["load"], l2)

    def forces(
        self, state: Symbols, action: Symbols, constants: Mapping[str, sympy.Symbol]
    ) -> Mapping[str, Any]:
        return {
            "shoulder": action[0] + viscous(state[2], constants["friction1"]),
            "elbow": action[1] + viscous(state[3], constants["friction2"]),
        }
