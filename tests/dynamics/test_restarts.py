"""Fits from other first weights: the best stays, and those as good are told."""

from __future__ import annotations

import copy

import pytest
import torch

from phihp_torchrl.dynamics import FitConfig, fit, fit_from_other_weights

from .test_fitting import PENDULUM, generator, make_loss, parameters, transitions

SHORT = FitConfig(steps=8, batch_size=None)


@pytest.fixture(scope="module")
def data():
    return transitions(PENDULUM, 60), transitions(PENDULUM, 20, seed=1)


def fitted(data):
    """A loss, its first parameters, and what a fit from them reports."""
    loss = make_loss(PENDULUM)
    initial = copy.deepcopy(loss.dynamics.state_dict())
    return loss, initial, fit(loss, *data, SHORT)


def again(loss, initial, report, data, restarts=2, seed=0):
    return fit_from_other_weights(
        loss, report, initial, *data, SHORT, generator(seed), restarts=restarts
    )


def held_out_error(loss, data):
    with torch.no_grad():
        return loss(data[1])["loss_prediction"].item()


def test_the_best_by_held_out_error_stays(data):
    loss, initial, once = fitted(data)
    best, others = again(loss, initial, once, data)
    assert best.held_out_error <= once.held_out_error
    assert held_out_error(loss, data) == pytest.approx(best.held_out_error)
    assert best.steps > once.steps
    assert best.seconds > once.seconds
    for known in others:
        other = copy.deepcopy(loss)
        other.dynamics.load_state_dict(known)
        error = held_out_error(other, data)
        assert best.held_out_error <= error <= 100 * best.held_out_error


def test_a_fit_that_went_astray_is_left_behind(data):
    loss, initial, _ = fitted(data)
    with torch.no_grad():
        loss.dynamics.residual.network[0].bias.add_(30.0)  # saturated: nothing leads out of it
    astray = fit(loss, *data, FitConfig(steps=1, batch_size=None))
    best, others = again(loss, initial, astray, data)
    assert best.held_out_error < astray.held_out_error / 100
    assert len(others) < 2  # that one does not describe the data as well


def test_a_good_fit_stays_as_it_is(data):
    """It is compared with a fit that had one step."""
    loss, initial, once = fitted(data)
    before = parameters(loss.dynamics)
    none = FitConfig(method="adam", steps=1, batch_size=None)
    best, others = fit_from_other_weights(loss, once, initial, *data, none, generator(), restarts=1)
    assert best.held_out_error == once.held_out_error
    assert torch.equal(parameters(loss.dynamics), before)
    assert not others


def test_first_weights_are_drawn_by_the_generator_alone(data):
    found = []
    for seed in (0, 0, 1):
        loss, initial, once = fitted(data)
        before = torch.get_rng_state()
        _, others = again(loss, initial, once, data, restarts=1, seed=seed)
        assert torch.equal(torch.get_rng_state(), before)
        (other,) = others
        found.append(torch.cat([value.flatten() for value in other.values()]))
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])
