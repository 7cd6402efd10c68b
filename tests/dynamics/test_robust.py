"""Huber's loss: weights lie above it, and a fit by it is not moved by what is far off."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl import HybridDynamics
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import DynamicsLoss, FitConfig, fit, robust
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld
from tests.dynamics.test_fitting import PENDULUM, SMOOTH, generator, make_loss, parameters, taken

sizes = st.floats(-100, 100)


@given(sizes, sizes, st.floats(0.01, 10))
def test_weighted_squares_lie_above_the_loss_and_touch_it(error, other, bend):
    e, o, b = (torch.tensor([[value]], dtype=torch.float64) for value in (error, other, bend))
    weight = robust.huber_weight(e, b)
    assert 0 < weight <= 1
    above = robust.huber_loss(e, b) + weight * (o.square() - e.square())
    assert above - robust.huber_loss(o, b) >= -1e-9 * (1 + above.abs())


@given(st.floats(0.01, 10))
def test_squares_turn_into_lines_without_a_jump(bend):
    b = torch.tensor([bend], dtype=torch.float64)
    errors = torch.tensor([[0.5], [1.0], [2.0], [3.0]], dtype=torch.float64) * bend
    found = robust.huber_loss(errors, b).flatten() / bend**2
    assert found.tolist() == pytest.approx([0.25, 1.0, 3.0, 5.0])
    infinite = torch.tensor([torch.inf], dtype=torch.float64)
    assert torch.equal(robust.huber_loss(errors, infinite), errors.square())
    assert (robust.huber_weight(errors, infinite) == 1).all()


def test_spread_is_that_of_most_errors():
    errors = 3.0 * torch.randn(2000, 2, generator=generator())
    errors[:200, 1] = 1e4
    assert robust.robust_spread(errors).tolist() == pytest.approx([3.0, 3.0], rel=0.15)
    assert (robust.robust_spread(torch.zeros(5, 2)) > 0).all()


def kicked(world, count, seed, share):
    """Transitions of a pendulum that something strikes in some steps, always the same way."""
    draws = generator(seed)
    state = PENDULUM.coverage.sample([count], generator=draws)
    action = PENDULUM.bounds.from_unit(2 * torch.rand(count, 1, generator=draws) - 1)
    data = taken(world, state, action)
    struck = torch.rand(count, generator=draws) < share
    data["next", "observation"][struck, 2] += 3.0 + action[struck, 0]
    return data


def gain_error(threshold, share=0.1):
    loss = make_loss(PENDULUM, "pure_prior")
    train, held_out = kicked(SMOOTH, 400, 0, share), kicked(SMOOTH, 200, 1, share)
    fit(loss, train, held_out, FitConfig(robust=threshold), generator())
    truth = PENDULUM.system.identifiable(SMOOTH.truth.constants)
    found = PENDULUM.system.identifiable(loss.dynamics.prior.constants())
    return max(abs(found[name].item() / value - 1) for name, value in truth.items())


def test_blows_that_move_a_least_squares_fit_leave_a_robust_one():
    assert gain_error(None) > 0.2
    assert gain_error(2.0) < 0.01
    assert gain_error(2.0, share=0.0) < 0.01


def test_friction_is_learned_by_a_robust_fit_too():
    world = SimulatedWorld(PENDULUM, SimulatedConfig(friction={"joint": 0.3}))
    train, held_out = kicked(world, 400, 0, 0.05), kicked(world, 200, 1, 0.05)
    loss = DynamicsLoss(HybridDynamics.hybrid(PENDULUM))
    fit(loss, train, held_out, FitConfig(robust=2.0), generator())
    clean = kicked(world, 200, 2, 0.0)
    before = DynamicsLoss(HybridDynamics.pure_prior(PENDULUM))(clean)["loss_prediction"]
    after = (loss(clean)["loss_prediction"]) * loss.error_scale.square().max()
    assert after < 0.02 * before


def test_a_threshold_that_nothing_reaches_is_the_fit_by_squares():
    train, held_out = kicked(SMOOTH, 100, 0, 0.0), kicked(SMOOTH, 50, 1, 0.0)
    fits = []
    for threshold in (None, 1e12):
        loss = make_loss(PENDULUM)
        fit(loss, train, held_out, FitConfig(steps=5, robust=threshold), generator())
        fits.append(parameters(loss))
    assert torch.equal(*fits)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_thresholds_out_of_range(value):
    with pytest.raises(ConfigError, match=r"^robust: expected "):
        FitConfig(robust=value)


def test_adam_has_squares_alone():
    with pytest.raises(ConfigError, match=r"^robust: expected null with method='adam'"):
        FitConfig(method="adam", robust=2.0)
