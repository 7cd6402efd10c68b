"""How sure a fit is of constants: as sure as repeated fits are, and honest about what is unseen."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import (
    DynamicsLoss,
    FitConfig,
    constants_covariance,
    draw_shifts,
    fit,
)

from .test_fitting import PENDULUM, SMOOTH, generator, make_loss, transitions


def noisy(data, std, seed):
    """The same transitions with noise on the velocity after the step."""
    noise = std * torch.randn(len(data), generator=generator(seed))
    following = data["next", "observation"].clone()
    following[:, 2] += noise
    return TensorDict(
        observation=data["observation"],
        action=data["action"],
        next=TensorDict(observation=following, batch_size=data.batch_size),
        batch_size=data.batch_size,
    )


def combined(prior, raw):
    """The two combinations of constants that the motion determines, as logarithms ``[n, 2]``."""
    values = PENDULUM.system.identifiable(prior.decode(raw))
    return torch.stack([value.log() for value in values.values()], -1)


def test_it_is_the_spread_of_fits_to_data_with_other_noise():
    clean, reference = transitions(SMOOTH, 300), transitions(SMOOTH, 300, seed=1)
    found, covariances = [], []
    for seed in range(24):
        loss = make_loss(PENDULUM, kind="pure_prior")
        train, held_out = noisy(clean, 0.05, seed), noisy(reference, 0.05, 1000 + seed)
        fit(loss, train, held_out, FitConfig(steps=6, batch_size=None), generator())
        prior = loss.dynamics.prior
        found.append(combined(prior, prior.log_constants.detach()))
        covariances.append(constants_covariance(loss, train, held_out))
    measured = torch.stack(found).std(0)
    covariance = torch.stack(covariances).mean(0)
    shifts = draw_shifts(covariance, 2000, generator())
    predicted = combined(prior, prior.log_constants.detach() + shifts).std(0)
    # The interval of a standard deviation of 24 is about 0.3 either way.
    assert ((predicted / measured) > 0.6).all()
    assert ((predicted / measured) < 1.6).all()


def test_more_data_and_less_noise_make_it_smaller():
    def size(count, std):
        loss = make_loss(PENDULUM, kind="pure_prior")
        train = noisy(transitions(SMOOTH, count), std, 0)
        held_out = noisy(transitions(SMOOTH, 200, seed=1), std, 1)
        fit(loss, train, held_out, FitConfig(steps=10, batch_size=None), generator())
        return constants_covariance(loss, train, held_out).trace()

    assert size(1600, 0.02) < 0.5 * size(400, 0.02)
    assert size(400, 0.005) < 0.2 * size(400, 0.02)


def test_sums_over_some_rows_stand_for_all():
    loss = make_loss(PENDULUM, kind="pure_prior")
    data = noisy(transitions(SMOOTH, 1000), 0.02, 0)
    fit(loss, data, data, FitConfig(steps=10, batch_size=None), generator())
    every, some = (constants_covariance(loss, data, data, rows=rows) for rows in (1000, 250))
    torch.testing.assert_close(some.trace(), every.trace(), rtol=0.3, atol=0.0)


def test_a_residual_that_may_take_over_makes_constants_less_sure():
    data = noisy(transitions(SMOOTH, 400), 0.02, 0)
    sizes = {}
    for kind in ("pure_prior", "hybrid"):
        loss = make_loss(PENDULUM, kind=kind)
        fit(loss, data, data, FitConfig(steps=10, batch_size=None), generator())
        sizes[kind] = constants_covariance(loss, data, data).trace()
    assert sizes["hybrid"] > 2 * sizes["pure_prior"]


def test_of_an_ensemble_it_is_the_first_members():
    data = noisy(transitions(SMOOTH, 200), 0.02, 0)
    found = []
    for ensemble in (1, 2):
        loss = make_loss(PENDULUM, model_options={"hidden_sizes": (6,), "ensemble": ensemble})
        fit(loss, data, data, FitConfig(steps=5, batch_size=None), generator())
        found.append(constants_covariance(loss, data, data))
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-9)


def test_draws_have_the_covariance_and_stay_in_the_interval():
    root = torch.tensor([[0.2, 0.0], [0.1, 0.05]])
    covariance = root @ root.mT
    draws = draw_shifts(covariance, 20_000, generator())
    # A normal variable cut off at 1.96 has 0.76 of its variance.
    torch.testing.assert_close(draws.mT.cov() / 0.76, covariance, rtol=0.05, atol=1e-4)
    values, vectors = torch.linalg.eigh(covariance)
    assert ((draws @ vectors).abs() <= 1.9601 * values.sqrt()).all()
    assert torch.equal(
        draw_shifts(covariance, 5, generator(1)), draw_shifts(covariance, 5, generator(1))
    )


def test_models_that_have_none_are_refused():
    data = transitions(SMOOTH, 20)
    with pytest.raises(ConfigError, match=r"^dynamics: expected a model with learned constants"):
        constants_covariance(DynamicsLoss(HybridDynamics.data_driven(PENDULUM)), data, data)
    adaptive = HybridDynamics.pure_prior(PENDULUM, integrator="dopri5")
    with pytest.raises(ConfigError, match=r"^integrator: expected one with fixed steps"):
        constants_covariance(DynamicsLoss(adaptive), data, data)
