"""The paper's systems from elsewhere: their energies, and the published equations, written here."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, Pendulum, System

SYSTEMS = [Pendulum, CartPole, Acrobot, ElbowAcrobot]
all_systems = pytest.mark.parametrize("kind", SYSTEMS)

NO_FRICTION = {"joint": 0.0, "cart": 0.0, "pole": 0.0, "joint1": 0.0, "joint2": 0.0}


def random_transition(system: System, n: int = 64, seed: int = 0):
    """States with velocities up to ±3 and angles over two turns, and actions, in float64."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda width: 2 * torch.rand(n, width, generator=generator, dtype=torch.float64) - 1  # noqa: E731
    scale = torch.full((system.state_dim,), 3.0, dtype=torch.float64)
    scale[list(system.angle_indices)] = 2 * math.pi
    return scale * draw(system.state_dim), 2 * draw(system.action_dim)


# Energies, from masses, lengths and velocities.


def pendulum_energy(state, c):
    theta, omega = state.unbind(-1)
    kinetic = 0.5 * (c["mass"] * c["length"] ** 2 / 3) * omega**2
    return kinetic + 0.5 * c["mass"] * c["gravity"] * c["length"] * theta.cos()


def cartpole_energy(state, c):
    _, v, theta, omega = state.unbind(-1)
    m, l = c["pole_mass"], c["half_length"]
    pole_v = torch.stack([v + l * omega * theta.cos(), -l * omega * theta.sin()], -1)
    rotation = 0.5 * (m * (2 * l) ** 2 / 12) * omega**2
    kinetic = 0.5 * c["cart_mass"] * v**2 + 0.5 * m * pole_v.square().sum(-1) + rotation
    return kinetic + m * c["gravity"] * l * theta.cos()


def acrobot_energy(state, c):
    theta1, theta2, omega1, omega2 = state.unbind(-1)
    total, spin = theta1 + theta2, omega1 + omega2
    center1 = c["center1"] * omega1  # speed of the first link's centre
    elbow = torch.stack([theta1.cos(), theta1.sin()], -1) * (c["length1"] * omega1)[..., None]
    center2 = elbow + torch.stack([total.cos(), total.sin()], -1) * (c["center2"] * spin)[..., None]
    kinetic = 0.5 * (
        c["mass1"] * center1**2
        + c["mass2"] * center2.square().sum(-1)
        + c["inertia1"] * omega1**2
        + c["inertia2"] * spin**2
    )
    height1 = -c["center1"] * theta1.cos()
    height2 = -c["length1"] * theta1.cos() - c["center2"] * total.cos()
    return kinetic + c["gravity"] * (c["mass1"] * height1 + c["mass2"] * height2)


ENERGY = {
    Pendulum: pendulum_energy,
    CartPole: cartpole_energy,
    Acrobot: acrobot_energy,
    ElbowAcrobot: acrobot_energy,
}


def action_power(system: System, state, action):
    """Rate at which the action does work."""
    velocities = [system.state_names.index(v) for v in system.velocity_of.values()]
    driven = {Pendulum: velocities, CartPole: velocities[:1], ElbowAcrobot: velocities[1:]}
    return (state[..., driven.get(type(system), velocities)] * action).sum(-1)


# The published equations, in plain Python.


def published_pendulum(s, a, c, b):
    theta, omega = s
    inertia = c["mass"] * c["length"] ** 2
    gravity = 3 * c["gravity"] / (2 * c["length"]) * math.sin(theta)
    return [omega, gravity + 3 * a[0] / inertia - b["joint"] * omega / inertia]


def published_cartpole(s, a, c, b):
    _, v, theta, omega = s
    m, l, total = c["pole_mass"], c["half_length"], c["pole_mass"] + c["cart_mass"]
    drag = b["cart"] * np.sign(v)
    sigma = (a[0] + m * l * omega**2 * math.sin(theta) - drag) / total
    pull = c["gravity"] * math.sin(theta) - math.cos(theta) * sigma - b["pole"] * omega / (m * l)
    alpha = pull / (l * (4 / 3 - m * math.cos(theta) ** 2 / total))
    return [v, sigma - m * l * alpha * math.cos(theta) / total, omega, alpha]


def manipulator_acrobot(s, a, c, b):
    theta1, theta2, omega1, omega2 = s
    torque = [0.0, *a] if len(a) == 1 else a
    m2, l1, lc1, lc2, g = (
        c[k] for k in ("mass2", "length1", "center1", "center2", "gravity")
    )  # mass 1 is 1
    h = m2 * l1 * lc2
    m22 = m2 * lc2**2 + c["inertia2"]
    m12 = m22 + h * math.cos(theta2)
    m11 = c["mass1"] * lc1**2 + c["inertia1"] + m2 * l1**2 + m22 + 2 * h * math.cos(theta2)
    coriolis = h * math.sin(theta2) * np.array([-(omega2**2) - 2 * omega1 * omega2, omega1**2])
    weight2 = m2 * g * lc2 * math.sin(theta1 + theta2)
    weight1 = (c["mass1"] * lc1 + m2 * l1) * g * math.sin(theta1) + weight2
    friction = np.array([b["joint1"] * omega1, b["joint2"] * omega2])
    rest = np.array(torque) - friction - coriolis - np.array([weight1, weight2])
    return [omega1, omega2, *np.linalg.solve([[m11, m12], [m12, m22]], rest)]


PUBLISHED = {
    Pendulum: published_pendulum,
    CartPole: published_cartpole,
    Acrobot: manipulator_acrobot,
    ElbowAcrobot: manipulator_acrobot,
}
