"""Equations derived from energies: those by hand, any batch and graph; and what is refused."""

from __future__ import annotations

import copy
import math
import pickle
import re

import pytest
import sympy
import torch
from physics import ENERGY, all_systems, random_transition

from phihp_torchrl.config import ConfigError
from phihp_torchrl.systems import CartDoublePendulum, Constant, LagrangianSystem, TwoLinkArm, terms

from .derived import DERIVED

EXAMPLES = [CartDoublePendulum, TwoLinkArm]
examples = pytest.mark.parametrize("kind", EXAMPLES)


class Slider(LagrangianSystem):
    """A mass on a spring; the tests change it where something is to be refused."""

    state_names, action_names = ("x", "x_dot"), ("push",)
    velocity_of = {"x": "x_dot"}
    default_constants = {"mass": 2.0, "stiffness": 3.0}

    def lagrangian(self, state, constants):
        x, x_dot = state
        return (constants["mass"] * x_dot**2 - constants["stiffness"] * x**2) / 2

    def forces(self, state, action, constants):
        return {"x": action[0]}


# The paper's systems


@all_systems
def test_derived_equations_are_those_by_hand(kind):
    by_hand, derived = kind(), DERIVED[kind]()
    state, action = random_transition(by_hand, n=256)
    generator = torch.Generator().manual_seed(1)
    constants = {
        name: value * (0.5 + torch.rand(256, generator=generator, dtype=torch.float64))
        for name, value in by_hand.constants.items()
    }
    ours = derived.prior(state, action, constants)
    assert (ours - by_hand.prior(state, action, constants)).abs().max() < 1e-6
    assert derived.constants == by_hand.constants
    assert derived.layout() == by_hand.layout()
    torch.testing.assert_close(derived.observe(state), by_hand.observe(state))


@all_systems
def test_derived_gradients_are_those_by_hand(kind):
    by_hand, derived = kind(), DERIVED[kind]()
    state, action = random_transition(by_hand, n=16)

    def gradients(system):
        constants = {
            name: torch.tensor(value, dtype=torch.float64, requires_grad=True)
            for name, value in system.constants.items()
        }
        inputs = (state.clone().requires_grad_(), action.clone().requires_grad_())
        rate = system.prior(*inputs, constants).square().sum()
        return torch.autograd.grad(rate, (*inputs, *constants.values()))

    for ours, expected in zip(gradients(derived), gradients(by_hand), strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-6, atol=1e-6)


@all_systems
def test_a_blow_is_that_of_the_mass_matrix(kind):
    by_hand, derived = kind(), DERIVED[kind]()
    state, _ = random_transition(by_hand)
    for i, (position, velocity) in enumerate(by_hand.velocity_of.items()):
        blow = derived.impulse(position, state, derived.constants)
        torch.testing.assert_close(blow, by_hand.impulse(position, state, by_hand.constants))
        torch.testing.assert_close(
            blow[:, by_hand.state_names.index(velocity)], torch.ones(64).double()
        )
        momentum = (
            derived.mass_matrix(state, derived.constants) @ blow[:, by_hand.velocity_indices, None]
        )
        others = momentum.squeeze(-1)[:, [j for j in range(len(by_hand.velocity_of)) if j != i]]
        torch.testing.assert_close(others, torch.zeros_like(others), rtol=0, atol=1e-9)


@all_systems
def test_the_mass_matrix_is_that_of_the_kinetic_energy(kind):
    derived = DERIVED[kind]()
    state, _ = random_transition(derived, n=4)
    indices = list(derived.velocity_indices)
    hessian = torch.func.vmap(torch.func.hessian(lambda s: ENERGY[kind](s, derived.constants)))
    expected = hessian(state)[:, indices][:, :, indices]
    torch.testing.assert_close(derived.mass_matrix(state, derived.constants), expected)


# Any derived system


def energy(system, state, constants):
    """Kinetic and potential energy: 2 T = vᵀ M v, and L = T - V."""
    velocity = state[..., list(system.velocity_indices)]
    twice = torch.einsum("bi,bij,bj->b", velocity, system.mass_matrix(state, constants), velocity)
    mechanics = system._mechanics()
    symbols = [sympy.Symbol(name) for name in (*system.state_names, *constants)]
    plain = dict(zip((*mechanics.state, *mechanics.constants), symbols, strict=True))
    lagrangian = sympy.lambdify(symbols, mechanics.lagrangian.xreplace(plain), modules="torch")
    numbers = [torch.tensor(value, dtype=state.dtype) for value in constants.values()]
    return twice - lagrangian(*state.unbind(-1), *numbers)


@examples
def test_the_action_and_friction_do_the_work_that_changes_the_energy(kind):
    system = kind()
    state, action = random_transition(system)
    constants = system.constants
    rate = system.prior(state, action, constants)
    _, power = torch.func.jvp(lambda s: energy(system, s, constants), (state,), (rate,))
    speed = state[:, list(system.velocity_indices)]
    if kind is TwoLinkArm:
        expected = (speed * action - 0.05 * speed.square()).sum(-1)
    else:
        expected = speed[:, 0] * action[:, 0]
    torch.testing.assert_close(power, expected, rtol=1e-9, atol=1e-9)


def test_with_a_weightless_second_rod_the_double_pendulum_is_a_cart_pole():
    double, single = (
        CartDoublePendulum(),
        DERIVED[next(k for k in DERIVED if k.__name__ == "CartPole")](),
    )
    state, action = random_transition(single, n=16)
    x, x_dot, theta, theta_dot = state.unbind(-1)
    zero = torch.zeros_like(x)
    both = torch.stack([x, theta, zero, x_dot, theta_dot, zero], -1)
    light = {**double.constants, "mass2": 1e-10, "gravity": 9.8, "mass1": 0.1, "length1": 1.0}
    rate = double.prior(both, action, light)
    expected = single.prior(state, action, single.constants)
    torch.testing.assert_close(rate[:, [0, 3, 1, 4]], expected, rtol=1e-6, atol=1e-6)


@examples
@pytest.mark.parametrize("batch", [(), (3,), (2, 0), (2, 3, 4)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_batch_and_dtype(kind, batch, dtype):
    system = kind()
    state = torch.randn(*batch, system.state_dim, dtype=dtype)
    rate = system.prior(
        state, torch.randn(*batch, system.action_dim, dtype=dtype), system.constants
    )
    assert rate.shape == state.shape
    assert rate.dtype == dtype


@examples
def test_it_is_one_graph_and_maps_over_a_batch(kind):
    system = kind()
    state, action = random_transition(system, n=5)
    prior = lambda s, a: system.prior(s, a, system.constants)  # noqa: E731
    expected = prior(state, action)
    torch.compiler.reset()
    compiled = torch.compile(prior, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(state, action), expected)
    torch.testing.assert_close(torch.func.vmap(prior)(state, action), expected)
    assert torch.autograd.gradcheck(
        prior, (state.requires_grad_(), action.requires_grad_()), fast_mode=True
    )


def test_it_copies_and_pickles_with_other_guesses():
    system = Slider()
    state, action = random_transition(system, n=4)
    expected = system.prior(state, action, system.constants)
    for again in (pickle.loads(pickle.dumps(system)), copy.deepcopy(system), Slider({"mass": 1.0})):
        assert torch.equal(again.prior(state, action, system.constants), expected)
    heavier = system.with_constants({"mass": 4.0})
    assert heavier.constants == {"mass": 4.0, "stiffness": 3.0}
    assert system.constants["mass"] == 2.0


def test_ranges_of_constants_are_those_of_any_system():
    class Tilted(Slider):
        default_constants = {"mass": Constant(2.0, fixed=True), "tilt": Constant(0.0, -0.3, 0.3)}

        def lagrangian(self, state, constants):
            gravity = 9.81 * constants["mass"] * sympy.sin(constants["tilt"])
            return constants["mass"] * state[1] ** 2 / 2 - gravity * state[0]

    tilted = Tilted()
    assert tilted.ranges["tilt"].bounded
    rate = tilted.prior(torch.zeros(3, 2), torch.zeros(3, 1), {"mass": 1.0, "tilt": 0.1})
    torch.testing.assert_close(rate[:, 1], torch.full((3,), -9.81 * math.sin(0.1)))


@pytest.mark.parametrize(
    ("force", "expected"),
    [
        (lambda x: sympy.sqrt(2) * x, lambda x: math.sqrt(2) * x),
        (lambda x: sympy.Max(x, 0, -x / 2), lambda x: torch.maximum(x, -x / 2)),
        (lambda x: sympy.Min(x, sympy.pi / 8), lambda x: x.clamp_max(math.pi / 8)),
        (lambda x: sympy.sin(1) * abs(x), lambda x: math.sin(1) * x.abs()),
        (lambda x: sympy.Heaviside(x, 0) * x**2, lambda x: x.relu().square()),
        (
            lambda x: sympy.Piecewise((x**3, x > 0.2), (1, True)),
            lambda x: torch.where(x > 0.2, x**3, 1.0),
        ),
        (lambda x: 5, lambda x: torch.full_like(x, 5.0)),
        (lambda x: sympy.sign(x) * sympy.exp(-x) / 3, lambda x: x.sign() * (-x).exp() / 3),
        (lambda x: terms.coulomb(x, 0.3, 0.1), lambda x: terms.coulomb(x, 0.3, 0.1)),
        (
            lambda x: terms.stop(x, x / 3, -0.5, 0.7, 100, 5),
            lambda x: terms.stop(x, x / 3, -0.5, 0.7, 100, 5),
        ),
    ],
)
def test_functions_that_a_force_may_use(force, expected):
    class Pushed(Slider):
        def lagrangian(self, state, constants):
            return state[1] ** 2 / 2

        def forces(self, state, action, constants):
            return {"x": force(state[0])}

    state = torch.tensor([[-1.0, 0.0], [-0.1, 0.0], [0.3, 0.0], [1.5, 0.0]], dtype=torch.float64)
    system = Pushed()
    prior = lambda s: system.prior(s, s[:, :1], system.constants)[:, 1]  # noqa: E731
    torch.testing.assert_close(prior(state), expected(state[:, 0]))
    torch.compiler.reset()
    torch.testing.assert_close(
        torch.compile(prior, fullgraph=True, backend="eager")(state), prior(state)
    )


# What is refused


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"lagrangian": lambda self, s, c: s[1] ** 2 - sympy.Symbol("wind")},
            "lagrangian: unknown ['wind'], expected an",
        ),
        (
            {"lagrangian": lambda self, s, c: s[1] ** 2 * sympy.Symbol("t")},
            "lagrangian: unknown ['t'], expected an",
        ),
        (
            {"lagrangian": lambda self, s, c: -c["mass"] * s[1] ** 2},
            "lagrangian: expected a kinetic energy",
        ),
        (
            {"lagrangian": lambda self, s, c: s[0] ** 2 * c["mass"]},
            "lagrangian: expected a kinetic energy",
        ),
        (
            {"forces": lambda self, s, a, c: {"y": a[0]}},
            "forces: unknown ['y'], expected some of ['x']",
        ),
        (
            {"forces": lambda self, s, a, c: {"x": s[1].diff(sympy.Symbol("t"))}},
            "forces: unknown ['Derivative(x(t), (t, 2))'",
        ),
        ({"velocity_of": {}}, "velocity_of: expected each component of the state to be a position"),
        (
            {"action_names": ("mass",)},
            "state_names: expected names that differ, got ['mass'] twice",
        ),
        ({"default_constants": {"mass": 0.0}}, "constants.mass: expected a value between"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        type("Wrong", (Slider,), change)()


def test_without_a_lagrangian_there_is_nothing_to_derive():
    class Empty(LagrangianSystem):
        state_names, action_names = ("x", "v"), ("u",)
        velocity_of = {"x": "v"}

    with pytest.raises(NotImplementedError, match="Empty: expected a method `lagrangian`"):
        Empty()
