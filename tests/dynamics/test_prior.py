"""F^p as a module: constants that are free, bounded or fixed, and learned from a guess."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import PhysicsPrior, perturbed_constants
from phihp_torchrl.systems import CartPole, Constant, Pendulum, System


class Spring(System):
    """One constant of each sort."""

    state_names, action_names = ("x", "v"), ("force",)
    velocity_of = {"x": "v"}
    default_constants = {
        "rest": Constant(0.1, low=-0.5, high=0.5),
        "stiffness": 2.0,
        "mass": Constant(1.5, fixed=True),
        "bias": Constant(-3.0, low=-4.0, high=-1.0),
    }

    def prior(self, state, action, constants):
        pull = constants["stiffness"] * (state[..., 0] - constants["rest"]) + constants["bias"]
        return torch.stack([state[..., 1], (action[..., 0] - pull) / constants["mass"]], -1)


class Known(Spring):
    """Nothing to learn."""

    default_constants = {
        name: Constant(guess, fixed=True)
        for name, guess in {"rest": 0.1, "stiffness": 2.0, "mass": 1.5, "bias": -3.0}.items()
    }


class Ranged(Spring):
    """A constant between any limits."""

    default_constants = {"rest": Constant(0.5, low=0.0, high=1.0), "stiffness": 1.0}


def values(prior):
    return {name: value.item() for name, value in prior.constants().items()}


# From a guess to the constants


def test_a_guess_comes_back_whatever_its_sort():
    prior = PhysicsPrior(Spring())
    assert values(prior) == pytest.approx(Spring().constants, rel=1e-5)
    assert list(prior.constants()) == ["rest", "stiffness", "mass", "bias"]
    guess = {"rest": -0.4, "stiffness": 7.0, "mass": 3.0, "bias": -1.5}
    assert values(PhysicsPrior(Spring(), guess)) == pytest.approx(guess, rel=1e-5)


@given(st.floats(1e-6, 1e6))
def test_any_positive_guess_comes_back(stiffness):
    found = values(PhysicsPrior(Spring(), {"stiffness": stiffness}))
    assert found["stiffness"] == pytest.approx(stiffness, rel=1e-5)


@given(st.floats(-1e3, 1e3), st.floats(1e-2, 1e3), st.floats(0.001, 0.999))
def test_any_guess_between_limits_comes_back(low, width, share):
    guess, high = low + share * width, low + width

    class Between(Ranged):
        default_constants = {"rest": Constant(guess, low=low, high=high), "stiffness": 1.0}

    found = values(PhysicsPrior(Between()).double())["rest"]
    assert found == pytest.approx(guess, abs=1e-4 * width)
    assert low < found < high


def test_it_starts_from_the_constants_of_its_system():
    assert values(PhysicsPrior(Pendulum({"length": 2.0})))["length"] == pytest.approx(2.0)
    both = PhysicsPrior(Pendulum({"length": 2.0, "mass": 3.0}), {"length": 4.0})
    assert values(both) == pytest.approx({"gravity": 10.0, "mass": 3.0, "length": 4.0})


def test_it_is_the_systems_prior():
    prior = PhysicsPrior(Spring(), {"rest": 0.3})
    state, action = torch.randn(8, 2), torch.randn(8, 1)
    expected = Spring().prior(state, action, {**Spring().constants, "rest": 0.3})
    torch.testing.assert_close(prior(state, action), expected)


# Learned, within limits, or not at all


def test_fixed_constants_are_no_parameters_and_get_no_gradient():
    prior = PhysicsPrior(Spring())
    assert prior.learned == ("rest", "stiffness", "bias")
    assert prior.log_constants.shape == (3,)
    constants = prior.constants()
    assert not constants["mass"].requires_grad
    assert all(constants[name].requires_grad for name in prior.learned)
    prior(torch.randn(8, 2), torch.randn(8, 1)).square().sum().backward()
    assert (prior.log_constants.grad != 0).all()


def test_where_all_is_known_nothing_is_learned():
    prior = PhysicsPrior(Known(), {"mass": 2.0})
    assert prior.learned == ()
    assert sum(parameter.numel() for parameter in prior.parameters()) == 0
    assert values(prior) == pytest.approx(
        {"rest": 0.1, "stiffness": 2.0, "mass": 2.0, "bias": -3.0}
    )
    state, action = torch.randn(8, 2), torch.randn(8, 1)
    expected = Spring().prior(state, action, {**Known().constants, "mass": 2.0})
    torch.testing.assert_close(prior(state, action), expected)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("rate", [0.5, 50.0])
def test_learning_never_leaves_the_limits(rate, sign):
    prior = PhysicsPrior(Spring()).double()
    optimizer = torch.optim.SGD(prior.parameters(), lr=rate)
    for _ in range(5):
        optimizer.zero_grad()
        (sign * torch.stack(list(prior.constants().values())).sum()).backward()
        optimizer.step()
        if rate > 1 and sign < 0:
            prior.log_constants.data.clamp_(max=30.0)  # a free constant grows without limit
    found = values(prior)
    assert -0.5 <= found["rest"] <= 0.5
    assert -4.0 <= found["bias"] <= -1.0
    assert found["stiffness"] > 0
    assert found["mass"] == 1.5
    if rate < 1:
        start = Spring().constants
        assert all(sign * found[name] < sign * start[name] for name in prior.learned)


def test_free_constants_stay_positive():
    prior = PhysicsPrior(CartPole(), constants={"pole_mass": 1e-3})
    guess = [value.item() for value in prior.constants().values()]
    optimizer = torch.optim.SGD(prior.parameters(), lr=0.5)
    for _ in range(5):
        optimizer.zero_grad()
        torch.stack(list(prior.constants().values())).sum().backward()
        optimizer.step()
    assert all(
        0 < value < start for value, start in zip(prior.constants().values(), guess, strict=True)
    )


def test_gradients_of_each_sort_are_right():
    prior = PhysicsPrior(Spring()).double()
    raw = prior.log_constants.detach().clone().requires_grad_()
    state, action = torch.randn(4, 2).double(), torch.randn(4, 1).double()
    assert torch.autograd.gradcheck(
        lambda raw: torch.func.functional_call(prior, {"log_constants": raw}, (state, action)), raw
    )


@pytest.mark.parametrize("system", [Pendulum(), Spring(), Known(), CartPole({"pole_mass": 0.3})])
def test_it_is_built_again_from_its_config_and_weights(system):
    prior = PhysicsPrior(system)
    with torch.no_grad():
        prior.log_constants.add_(0.3)
    again = PhysicsPrior.from_config(type(system)(), prior.config)
    assert again.config == prior.config
    again.load_state_dict(prior.state_dict())
    assert values(again) == values(prior)


def test_what_is_fixed_is_in_its_config():
    assert PhysicsPrior(Pendulum()).config == {"kind": "learned"}
    prior = PhysicsPrior(Spring(), {"mass": 2.5, "stiffness": 9.0})
    assert prior.config == {"kind": "learned", "fixed": {"mass": 2.5}}
    assert values(PhysicsPrior.from_config(Spring(), prior.config))["mass"] == 2.5


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"height": 1.0}, r"constants: unknown \['height'\], expected some of"),
        ({"stiffness": 0.0}, r"constants\.stiffness: expected a value between 0\.0 and inf"),
        ({"stiffness": math.nan}, r"constants\.stiffness: expected finite numbers"),
        ({"rest": 0.5}, r"constants\.rest: expected a value between -0\.5 and 0\.5, got 0\.5"),
        ({"bias": 0.0}, r"constants\.bias: expected a value between -4\.0 and -1\.0, got 0\.0"),
    ],
)
def test_a_guess_out_of_its_range_is_named(constants, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        PhysicsPrior(Spring(), constants)


# A wrong guess on purpose


def test_perturbed_constants():
    constants = CartPole().constants
    guess = perturbed_constants(constants, 0.3, torch.Generator().manual_seed(0))
    for name, value in constants.items():
        assert abs(guess[name] / value - 1) == pytest.approx(0.3)
    again = perturbed_constants(constants, 0.3, torch.Generator().manual_seed(0))
    assert guess == again
    seen = {
        tuple(perturbed_constants(constants, 0.3, torch.Generator().manual_seed(seed)).values())
        for seed in range(50)
    }
    assert len(seen) > 8, "signs are drawn for each constant by itself"
    assert perturbed_constants(constants, 0.0) == constants


@pytest.mark.parametrize("error", [-0.1, 1.0, math.nan])
def test_perturbed_constants_stay_positive(error):
    with pytest.raises(ConfigError, match=r"^error: expected a relative error in \[0, 1\), got"):
        perturbed_constants(Pendulum().constants, error)
