"""The paper's systems by their energies alone, to compare with the equations by hand."""

from __future__ import annotations

import sympy

from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, LagrangianSystem, Pendulum


def declared_as(kind):
    """What a class of a Lagrangian has to declare, taken from the one by hand."""
    names = ("state_names", "action_names", "angles", "velocity_of", "default_constants")
    return {name: getattr(kind, name) for name in names}


class LagrangianPendulum(LagrangianSystem):
    vars().update(declared_as(Pendulum))

    def lagrangian(self, state, constants):
        (theta, theta_dot), c = state, constants
        inertia = c["mass"] * c["length"] ** 2 / 3
        height = c["length"] * sympy.cos(theta) / 2
        return inertia * theta_dot**2 / 2 - c["mass"] * c["gravity"] * height

    def forces(self, state, action, constants):
        return {"theta": action[0]}


class LagrangianCartPole(LagrangianSystem):
    vars().update(declared_as(CartPole))

    def lagrangian(self, state, constants):
        (x, x_dot, theta, theta_dot), c = state, constants
        time = sympy.Symbol("t")
        l, m = c["half_length"], c["pole_mass"]
        pole = sympy.Matrix([x + l * sympy.sin(theta), l * sympy.cos(theta)])
        speed = pole.diff(time)  # positions are functions of time, so their velocities derive
        kinetic = c["cart_mass"] * x_dot**2 + m * speed.dot(speed) + m * l**2 / 3 * theta_dot**2
        return kinetic / 2 - m * c["gravity"] * pole[1]

    def forces(self, state, action, constants):
        return {"x": action[0]}


class LagrangianAcrobot(LagrangianSystem):
    vars().update(declared_as(Acrobot))

    def lagrangian(self, state, constants):
        (theta1, theta2, omega1, omega2), c = state, constants
        total, spin = theta1 + theta2, omega1 + omega2
        elbow = c["length1"] * omega1 * sympy.Matrix([sympy.cos(theta1), sympy.sin(theta1)])
        second = elbow + c["center2"] * spin * sympy.Matrix([sympy.cos(total), sympy.sin(total)])
        kinetic = c["mass1"] * (c["center1"] * omega1) ** 2 + c["mass2"] * second.dot(second)
        kinetic += c["inertia1"] * omega1**2 + c["inertia2"] * spin**2
        height = -c["mass1"] * c["center1"] * sympy.cos(theta1)
        height -= c["mass2"] * (c["length1"] * sympy.cos(theta1) + c["center2"] * sympy.cos(total))
        return kinetic / 2 - c["gravity"] * height

    def forces(self, state, action, constants):
        return dict(zip(("theta1", "theta2"), action, strict=True))


class LagrangianElbowAcrobot(LagrangianAcrobot):
    vars().update(declared_as(ElbowAcrobot))

    def forces(self, state, action, constants):
        return {"theta2": action[0]}


DERIVED = {
    Pendulum: LagrangianPendulum,
    CartPole: LagrangianCartPole,
    Acrobot: LagrangianAcrobot,
    ElbowAcrobot: LagrangianElbowAcrobot,
}
