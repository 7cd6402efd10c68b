"""What holds for every system: geometry, first guesses, and priors that are pure functions."""

from __future__ import annotations

import math
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from physics import ENERGY, NO_FRICTION, PUBLISHED, action_power, all_systems, random_transition

from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.systems import Acrobot, CartPole, Constant, Pendulum, System, override, wrap

# The equations


@pytest.mark.parametrize("scale", [1.0, 1.3])
@all_systems
def test_the_prior_is_the_published_equation_without_friction(kind, scale):
    system = kind({name: scale * value for name, value in kind().constants.items()})
    state, action = random_transition(system)
    expected = [
        PUBLISHED[kind](s, a, system.constants, NO_FRICTION)
        for s, a in zip(state.tolist(), action.tolist(), strict=True)
    ]
    torch.testing.assert_close(
        system.prior(state, action, system.constants), torch.tensor(expected, dtype=torch.float64)
    )


@all_systems
def test_work_of_the_action_is_the_change_of_energy(kind):
    system = kind()
    state, action = random_transition(system)
    rate = system.prior(state, action, system.constants)
    _, power = torch.func.jvp(lambda s: ENERGY[kind](s, system.constants), (state,), (rate,))
    torch.testing.assert_close(power, action_power(system, state, action), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("integrator", ["rk4", "dopri5"])
@all_systems
def test_energy_is_conserved(kind, integrator):
    system, solve = kind(), make_integrator(integrator)
    state, action = random_transition(system, n=8)
    idle = torch.zeros_like(action)
    start = ENERGY[kind](state, system.constants)
    for _ in range(50):
        slope = lambda s: system.prior(s, idle, system.constants)  # noqa: E731
        state = solve(slope, state, 0.01, system.layout())
        energy = ENERGY[kind](state, system.constants)
        torch.testing.assert_close(energy, start, rtol=1e-6, atol=1e-5)


@all_systems
def test_full_turns_change_nothing(kind):
    system = kind()
    state, action = random_transition(system)
    turned = state.clone()
    turned[:32, list(system.angle_indices)] += 2 * math.pi
    turned[32:, list(system.angle_indices)] -= 4 * math.pi
    for f in (
        lambda s, a: system.prior(s, a, system.constants),
        lambda s, a: system.observe(s),
    ):
        torch.testing.assert_close(f(turned, action), f(state, action), rtol=1e-9, atol=1e-9)
    zero = torch.zeros_like(state)
    torch.testing.assert_close(system.difference(turned, state), zero, rtol=0, atol=1e-9)


@all_systems
def test_the_prior_reads_no_constants_but_those_it_is_given(kind):
    state, action = random_transition(kind())
    guess = kind().constants
    other = kind({name: 2 * value for name, value in guess.items()})
    assert torch.equal(other.prior(state, action, guess), kind().prior(state, action, guess))
    assert not torch.equal(
        other.prior(state, action, other.constants), kind().prior(state, action, guess)
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


@pytest.mark.parametrize("batch", [(), (3,), (2, 0), (2, 3, 4)])
@all_systems
def test_any_leading_batch_dimensions(kind, batch):
    system = kind()
    state, action = torch.randn(*batch, system.state_dim), torch.randn(*batch, system.action_dim)
    rate = system.prior(state, action, system.constants)
    assert rate.shape == state.shape
    assert rate.dtype == state.dtype
    assert system.locate(system.observe(state)).shape == state.shape


@all_systems
def test_splitting_a_batch_changes_nothing(kind):
    system = kind()
    state, action = random_transition(system, n=12)
    whole = system.prior(state, action, system.constants)
    rows = [system.prior(s, a, system.constants) for s, a in zip(state, action, strict=True)]
    torch.testing.assert_close(torch.stack(rows), whole, rtol=1e-13, atol=1e-13)


@all_systems
def test_constants_may_be_tensors_that_differ_over_the_batch(kind):
    system = kind()
    state, action = random_transition(system, n=2)
    constants = {k: torch.tensor([v, 1.5 * v]) for k, v in system.constants.items()}
    joint = system.prior(state, action, constants)
    for i, factor in enumerate((1.0, 1.5)):
        single = {k: factor * v for k, v in system.constants.items()}
        torch.testing.assert_close(joint[i], system.prior(state[i], action[i], single))


# Geometry

angles = st.floats(-100, 100)


@given(st.lists(angles, min_size=1, max_size=8), st.integers(-5, 5))
def test_wrap_is_the_same_point_of_the_half_open_circle(values, turns):
    angle = torch.tensor(values, dtype=torch.float64)
    wrapped = wrap(angle)
    assert ((wrapped >= -math.pi) & (wrapped < math.pi)).all()
    torch.testing.assert_close(wrapped.sin(), angle.sin(), rtol=0, atol=1e-12)
    torch.testing.assert_close(wrapped.cos(), angle.cos(), rtol=0, atol=1e-12)
    torch.testing.assert_close(wrap(wrapped), wrapped, rtol=0, atol=1e-12)
    turned = wrap(angle + 2 * math.pi * turns)
    gap = (turned - wrapped).abs()  # at the seam both ends of the circle are the same point
    assert (torch.minimum(gap, 2 * math.pi - gap) < 1e-11).all()


def test_wrap_of_half_a_turn_is_its_lower_end():
    assert wrap(torch.tensor(math.pi, dtype=torch.float64)).item() == -math.pi


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


@all_systems
@given(st.data())
def test_any_state_comes_back_from_its_observation(kind, data):
    system = kind()
    row = st.lists(st.floats(-50, 50), min_size=system.state_dim, max_size=system.state_dim)
    rows = data.draw(st.lists(row, min_size=1, max_size=3))
    state = torch.tensor(rows, dtype=torch.float64)
    located = system.locate(system.observe(state))
    gap = system.difference(located, state)
    assert gap.abs().max() < 1e-11
    assert torch.equal(system.difference(state, state), torch.zeros_like(state))
    torch.testing.assert_close(system.locate(system.observe(located)), located)


def test_observations_are_in_the_published_order():
    cos, sin = math.cos, math.sin
    for system, state, expected in (
        (Pendulum(), [1.0, 2.0], [cos(1), sin(1), 2]),
        (CartPole(), [1.0, 2.0, 3.0, 4.0], [1, 2, cos(3), sin(3), 4]),
        (Acrobot(), [1.0, 2.0, 3.0, 4.0], [cos(1), sin(1), cos(2), sin(2), 3, 4]),
    ):
        assert system.observe(torch.tensor(state)).tolist() == pytest.approx(expected)


def test_the_layout_pairs_positions_with_their_velocities():
    layout = CartPole().layout({"theta_dot": (-1.0, 2.0)})
    inf = math.inf
    assert (layout.size, layout.pairs) == (4, ((0, 1), (2, 3)))
    assert layout.limits == ((-inf, inf), (-1.0, 2.0))
    assert CartPole().layout({"x_dot": 3.0}).limits == ((-3.0, 3.0), (-inf, inf))


# First guesses


def test_first_guesses_are_the_published_constants():
    assert Pendulum().constants == {"gravity": 10.0, "mass": 1.0, "length": 1.0}
    assert CartPole().constants == {
        "gravity": 9.8,
        "cart_mass": 1.0,
        "pole_mass": 0.1,
        "half_length": 0.5,
    }


@all_systems
def test_a_plain_number_is_a_free_constant(kind):
    for name, constant in kind().ranges.items():
        assert constant == Constant(kind.default_constants[name])
        assert (constant.low, constant.high, constant.fixed) == (0.0, math.inf, False)


class Spring(System):
    """One constant of each sort."""

    state_names, action_names = ("x", "v"), ("force",)
    velocity_of = {"x": "v"}
    default_constants = {
        "stiffness": 2.0,
        "rest": Constant(0.1, low=-0.5, high=0.5),
        "mass": Constant(1.5, fixed=True),
    }

    def prior(self, state, action, constants):
        pull = action[..., 0] - constants["stiffness"] * (state[..., 0] - constants["rest"])
        return torch.stack([state[..., 1], pull / constants["mass"]], -1)


def test_other_guesses_keep_their_ranges_and_leave_the_system_alone():
    spring = Spring()
    other = spring.with_constants({"rest": -0.25, "mass": 3.0})
    assert spring.constants == {"stiffness": 2.0, "rest": 0.1, "mass": 1.5}
    assert other.constants == {"stiffness": 2.0, "rest": -0.25, "mass": 3.0}
    assert other.ranges["rest"] == Constant(-0.25, low=-0.5, high=0.5)
    assert other.ranges["mass"] == Constant(3.0, fixed=True)
    assert other.constants == Spring({"rest": -0.25, "mass": 3.0}).constants
    assert type(other) is Spring
    assert other.with_constants({}).constants == other.constants


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6) | st.just(math.inf))
def test_a_guess_lies_between_its_limits_or_is_refused(guess, low, high):
    if low < guess < high and (high < math.inf or low == 0):
        assert Constant(guess, low, high).bounded == (high < math.inf)
    else:
        with pytest.raises(ConfigError, match=r"^(guess|high): expected a "):
            Constant(guess, low, high)
    assert Constant(guess, low, high, fixed=True).guess == guess


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"guess": math.nan}, "guess"),
        ({"guess": "9.81"}, "guess"),
        ({"guess": None}, "guess"),
        ({"guess": 1.0, "high": "2"}, "guess"),
        ({"guess": math.inf}, "guess"),
        ({"guess": math.nan, "fixed": True}, "guess"),
        ({"guess": 0.0}, "guess"),
        ({"guess": -1.0}, "guess"),
        ({"guess": 1.0, "low": -math.inf}, "guess"),
        ({"guess": 1.0, "low": 0.5}, "high"),
        ({"guess": 1.0, "low": 0.0, "high": 1.0}, "guess"),
        ({"guess": 1.0, "high": math.nan}, "guess"),
    ],
)
def test_a_constant_out_of_range_is_named(options, key):
    with pytest.raises(ConfigError, match=f"^{key}: expected "):
        Constant(**options)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@all_systems
def test_free_constants_must_be_positive_and_finite(kind, value):
    name = next(iter(kind.default_constants))
    for make in (kind, kind().with_constants):
        with pytest.raises(ConfigError, match=rf"^constants\.{name}: expected "):
            make({name: value})


@all_systems
def test_unknown_names_are_told(kind):
    for make in (kind, kind().with_constants):
        with pytest.raises(ConfigError, match=r"^constants: unknown \['wind'\], expected some of"):
            make({"wind": 1.0})
    with pytest.raises(ConfigError, match=r"^velocity_limits: unknown \['wind'\], expected some"):
        kind().layout({"wind": 1.0})


def test_a_declared_constant_out_of_range_is_named():
    class Weightless(Spring):
        default_constants = {"mass": 0.0}

    with pytest.raises(ConfigError, match=r"^constants\.mass: expected a value between 0\.0 and"):
        Weightless()


def test_a_system_without_equations_says_so():
    class Unknown(System):
        state_names, action_names = ("x",), ("u",)

    assert not Unknown().has_prior
    assert Spring().has_prior
    with pytest.raises(NotImplementedError, match="Unknown: this system has no prior"):
        Unknown().prior(torch.zeros(1), torch.zeros(1), {})


def test_named_numbers_are_overridden_by_name():
    assert override("what", {"a": 1, "b": 2.0}, {"b": 3}) == {"a": 1.0, "b": 3.0}
    assert override("what", {"a": 1}, None) == {"a": 1.0}
    message = re.escape("what: unknown ['c', 'd'], expected some of ['a', 'b'].")
    with pytest.raises(ConfigError, match=f"^{message}$"):
        override("what", {"b": 1, "a": 2}, {"d": 1, "c": 1})
