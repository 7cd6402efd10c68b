"""Physics: checked against energies, the published equations and gymnasium, all written here."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv

from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, Pendulum, System, wrap

SYSTEMS = [Pendulum, CartPole, Acrobot, ElbowAcrobot]
all_systems = pytest.mark.parametrize("kind", SYSTEMS)


def random_transition(system: System, n: int = 64, seed: int = 0):
    """States with velocities up to ±3 and angles over two turns, and actions, in float64."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda width: 2 * torch.rand(n, width, generator=generator, dtype=torch.float64) - 1  # noqa: E731
    scale = torch.full((system.state_dim,), 3.0, dtype=torch.float64)
    scale[list(system.angle_indices)] = 2 * math.pi
    return scale * draw(system.state_dim), 2 * draw(system.action_dim)


def frictionless(kind: type[System]) -> System:
    return kind(friction_constants=dict.fromkeys(kind.default_friction, 0.0))


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


def friction_power(system: System, state):
    """Rate at which friction takes energy away."""
    b = system.friction_constants
    if isinstance(system, Pendulum):  # b is on 3 times the torque: the published equation
        return b["joint"] * state[..., 1] ** 2 / 3
    if isinstance(system, CartPole):
        return b["cart"] * state[..., 1].abs() + b["pole"] * state[..., 3] ** 2
    return b["joint1"] * state[..., 2] ** 2 + b["joint2"] * state[..., 3] ** 2


def action_power(system: System, state, action):
    """Rate at which the action does work."""
    velocities = [system.state_names.index(v) for v in system.velocity_of.values()]
    driven = {Pendulum: velocities, CartPole: velocities[:1], ElbowAcrobot: velocities[1:]}
    return (state[..., driven.get(type(system), velocities)] * action).sum(-1)


@all_systems
def test_work_of_the_action_less_friction_is_the_change_of_energy(kind):
    system = kind()
    state, action = random_transition(system)
    _, rate = torch.func.jvp(
        lambda s: ENERGY[kind](s, system.constants), (state,), (system.derivative(state, action),)
    )
    expected = action_power(system, state, action) - friction_power(system, state)
    torch.testing.assert_close(rate, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("integrator", ["rk4", "dopri5"])
@all_systems
def test_energy_is_conserved_without_friction_and_falls_with_it(kind, integrator):
    solve = make_integrator(integrator)
    for system, has_friction in ((frictionless(kind), False), (kind(), True)):
        state, action = random_transition(system, n=8)
        idle = torch.zeros_like(action)
        energies = [ENERGY[kind](state, system.constants)]
        for _ in range(50):
            state = solve(lambda s: system.derivative(s, idle), state, 0.01, system.layout())  # noqa: B023
            energies.append(ENERGY[kind](state, system.constants))
        energy = torch.stack(energies)
        if has_friction:
            assert (energy.diff(dim=0) < 0).all()
        else:
            torch.testing.assert_close(energy, energy[0].expand_as(energy), rtol=1e-6, atol=1e-5)


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


@pytest.mark.parametrize("scale", [1.0, 1.3])
@all_systems
def test_derivative_is_the_published_equation(kind, scale):
    system = kind(
        {k: scale * v for k, v in kind.default_constants.items()},
        {k: scale * v for k, v in kind.default_friction.items()},
    )
    state, action = random_transition(system)
    expected = [
        PUBLISHED[kind](s, a, system.constants, system.friction_constants)
        for s, a in zip(state.tolist(), action.tolist(), strict=True)
    ]
    torch.testing.assert_close(
        system.derivative(state, action), torch.tensor(expected, dtype=torch.float64)
    )


def test_true_constants_are_those_of_the_published_worlds():
    assert Pendulum().constants == {"gravity": 10.0, "mass": 1.0, "length": 1.0}
    assert Pendulum().friction_constants == {"joint": 0.5}
    assert CartPole().constants == {
        "gravity": 9.8,
        "cart_mass": 1.0,
        "pole_mass": 0.1,
        "half_length": 0.5,
    }
    assert CartPole().friction_constants == {"cart": 0.1, "pole": 0.02}
    for arm in (Acrobot(), ElbowAcrobot()):
        assert arm.friction_constants == {"joint1": 0.01, "joint2": 0.05}
        assert arm.constants["gravity"] == 9.8
        assert arm.constants["center1"] == arm.constants["center2"] == 0.5
        assert {
            arm.constants[k] for k in ("mass1", "mass2", "length1", "inertia1", "inertia2")
        } == {1}


def test_elbow_acrobot_prior_is_gymnasiums_book_acrobot():
    book, system = AcrobotEnv(), ElbowAcrobot()
    assert book.book_or_nips == "book"
    state, action = random_transition(system)
    augmented = torch.cat([state, action], -1).numpy()
    expected = np.array([book._dsdt(s)[:4] for s in augmented])
    actual = system.prior(state, action, system.constants).numpy()
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


def test_full_acrobot_with_an_idle_hinge_is_the_elbow_acrobot():
    state, action = random_transition(ElbowAcrobot())
    both = torch.cat([torch.zeros_like(action), action], -1)
    torch.testing.assert_close(
        Acrobot().derivative(state, both), ElbowAcrobot().derivative(state, action)
    )


@pytest.mark.parametrize("push", [0, 1])
def test_frictionless_cartpole_steps_like_gymnasiums(push):
    gym_env, system = CartPoleEnv(), frictionless(CartPole)
    gym_env.kinematics_integrator = "semi-implicit euler"
    gym_env.theta_threshold_radians = math.inf
    gym_env.reset(seed=0)
    state = torch.tensor(gym_env.state)
    force = torch.tensor([20.0 * push - 10.0], dtype=torch.float64)
    step = make_integrator("semi_implicit_euler")
    for _ in range(20):
        gym_env.step(push)
        state = step(lambda s: system.derivative(s, force), state, 0.02, system.layout())
        np.testing.assert_allclose(state.numpy(), gym_env.state, rtol=1e-10, atol=1e-12)


# Properties.


@all_systems
def test_full_turns_change_nothing(kind):
    system = kind()
    state, action = random_transition(system)
    turned = state.clone()
    turned[:32, list(system.angle_indices)] += 2 * math.pi
    turned[32:, list(system.angle_indices)] -= 4 * math.pi
    for f in (system.derivative, lambda s, a: system.observe(s)):
        torch.testing.assert_close(f(turned, action), f(state, action), rtol=1e-9, atol=1e-9)
    zero = torch.zeros_like(state)
    torch.testing.assert_close(system.difference(turned, state), zero, rtol=0, atol=1e-9)


@all_systems
def test_prior_does_not_read_the_worlds_friction_or_constants(kind):
    state, action = random_transition(kind())
    other = kind(
        {k: 2 * v for k, v in kind.default_constants.items()},
        {k: 10 * v + 1 for k, v in kind.default_friction.items()},
    )
    guess = kind.default_constants
    assert torch.equal(other.prior(state, action, guess), kind().prior(state, action, guess))
    assert not torch.equal(other.friction(state, action), kind().friction(state, action))


@all_systems
def test_zero_friction_leaves_the_prior(kind):
    system = frictionless(kind)
    state, action = random_transition(system)
    torch.testing.assert_close(
        system.derivative(state, action), system.prior(state, action, system.constants)
    )


EQUIVALENT = {
    Pendulum: {"gravity": 20.0, "length": 2.0, "mass": 0.25},
    Acrobot: {
        "mass1": 1.4,
        "mass2": 0.8,
        "center1": 0.5,
        "center2": 0.625,
        "inertia1": 1.1,
        "inertia2": 0.9375,
    },
}


@pytest.mark.parametrize("kind", [Pendulum, Acrobot])
def test_identifiable_combinations_determine_the_prior(kind):
    system = kind()
    equivalent = {**kind.default_constants, **EQUIVALENT[kind]}
    state, action = random_transition(system)
    assert system.identifiable(equivalent) == pytest.approx(
        system.identifiable(kind.default_constants)
    )
    torch.testing.assert_close(
        system.prior(state, action, equivalent), system.prior(state, action, system.constants)
    )


@all_systems
def test_every_constant_that_moves_an_identifiable_combination_moves_the_prior(kind):
    system = kind()
    state, action = random_transition(system)
    reference = system.prior(state, action, system.constants)
    for name, value in system.constants.items():
        changed = {**system.constants, name: 1.2 * value}
        assert system.identifiable(changed) != system.identifiable(system.constants)
        assert not torch.allclose(system.prior(state, action, changed), reference), name


@all_systems
def test_locate_inverts_observe(kind):
    system = kind()
    state, _ = random_transition(system)
    observation = system.observe(state)
    assert observation.shape == (64, system.observation_dim)
    located = system.locate(observation)
    torch.testing.assert_close(system.observe(located), observation)
    zero = torch.zeros_like(state)
    torch.testing.assert_close(system.difference(located, state), zero, rtol=0, atol=1e-9)
    assert (located[:, list(system.angle_indices)].abs() <= math.pi).all()


def test_observations_are_in_the_published_order():
    cos, sin = math.cos, math.sin
    for system, state, expected in (
        (Pendulum(), [1.0, 2.0], [cos(1), sin(1), 2]),
        (CartPole(), [1.0, 2.0, 3.0, 4.0], [1, 2, cos(3), sin(3), 4]),
        (Acrobot(), [1.0, 2.0, 3.0, 4.0], [cos(1), sin(1), cos(2), sin(2), 3, 4]),
    ):
        assert system.observe(torch.tensor(state)).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("batch", [(), (3,), (2, 0), (2, 3, 4)])
@all_systems
def test_any_leading_batch_dimensions(kind, batch):
    system = kind()
    state, action = torch.randn(*batch, system.state_dim), torch.randn(*batch, system.action_dim)
    for value in (system.derivative(state, action), system.friction(state, action)):
        assert value.shape == state.shape
        assert value.dtype == state.dtype
    assert system.locate(system.observe(state)).shape == state.shape


@all_systems
def test_constants_may_be_tensors_that_differ_over_the_batch(kind):
    system = kind()
    state, action = random_transition(system, n=2)
    constants = {k: torch.tensor([v, 1.5 * v]) for k, v in system.constants.items()}
    joint = system.prior(state, action, constants)
    for i, factor in enumerate((1.0, 1.5)):
        single = {k: factor * v for k, v in system.constants.items()}
        torch.testing.assert_close(joint[i], system.prior(state[i], action[i], single))


def test_wrap_maps_to_the_half_open_circle():
    angles = torch.tensor([0.0, 3.0, -3.0, 4.0, -4.0, 100.0], dtype=torch.float64)
    wrapped = wrap(angles)
    assert ((wrapped >= -math.pi) & (wrapped < math.pi)).all()
    torch.testing.assert_close(wrapped.sin(), angles.sin())
    torch.testing.assert_close(wrapped.cos(), angles.cos())
    assert wrap(torch.tensor(math.pi, dtype=torch.float64)).item() == -math.pi


# Bad input.


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@all_systems
def test_constants_must_be_positive_and_finite(kind, value):
    name = next(iter(kind.default_constants))
    with pytest.raises(ValueError, match=f"^constants: .*{name}"):
        kind({name: value})


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
@all_systems
def test_friction_must_not_push(kind, value):
    name = next(iter(kind.default_friction))
    with pytest.raises(ValueError, match=f"^friction_constants: .*{name}"):
        kind(friction_constants={name: value})


@all_systems
def test_unknown_constants_are_named(kind):
    with pytest.raises(ValueError, match=r"^constants: unknown \['wind'\], expected some of"):
        kind({"wind": 1.0})
    with pytest.raises(ValueError, match=r"^friction_constants: unknown \['wind'\]"):
        kind(friction_constants={"wind": 1.0})
    with pytest.raises(ValueError, match=r"^velocity_limits: unknown \['wind'\]"):
        kind().layout({"wind": 1.0})
