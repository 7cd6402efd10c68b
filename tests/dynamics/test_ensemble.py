"""F^r as an ensemble: a single member is what it was, members differ, and come back from files."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import DynamicsLoss, EnsembleResidual, FitConfig, ResidualMLP, fit
from phihp_torchrl.systems import CartPole

from .draws import draw
from .test_fitting import PENDULUM, generator, make_loss, transitions

SHORT = FitConfig(steps=10, batch_size=None)


def test_one_member_is_a_single_residual_bit_for_bit():
    task = get_task("cartpole")
    torch.manual_seed(0)
    single = HybridDynamics.hybrid(task)
    drawn = torch.rand(())
    torch.manual_seed(0)
    one = HybridDynamics.hybrid(task, ensemble=1)
    assert type(one.residual) is ResidualMLP
    assert torch.equal(torch.rand(()), drawn)  # as much of the generator is used
    state, action = draw(task, 20)
    assert torch.equal(one(state, action), single(state, action))
    assert "members" not in one.config["residual"]


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
def test_the_mean_is_that_of_networks_evaluated_one_by_one(batch):
    ensemble = EnsembleResidual(CartPole(), 3, (8, 4), (1, 3))
    ensemble.set_scales(torch.randn(50, 4), torch.randn(50, 1), torch.randn(50, 4))
    state, action = torch.randn(*batch, 4), torch.randn(*batch, 1)
    each = torch.stack([ensemble.member(k)(state, action) for k in range(3)])
    torch.testing.assert_close(ensemble.each(state, action), each)
    torch.testing.assert_close(ensemble(state, action), each.mean(0))


def test_its_first_network_is_the_one_that_a_single_residual_has():
    torch.manual_seed(3)
    single = ResidualMLP(CartPole())
    torch.manual_seed(3)
    first = EnsembleResidual(CartPole(), 4).member(0)
    for one, other in zip(single.parameters(), first.parameters(), strict=True):
        assert torch.equal(one, other)


def test_taking_a_member_out_leaves_the_global_generator_alone():
    ensemble = EnsembleResidual(CartPole(), 2)
    before = torch.get_rng_state()
    ensemble.member(1)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_member_that_is_put_back_is_that_member_alone():
    ensemble = EnsembleResidual(CartPole(), 3)
    others = [ensemble.member(k) for k in (0, 2)]
    new = ResidualMLP(CartPole())
    ensemble.set_member(1, new)
    state, action = torch.randn(5, 4), torch.randn(5, 1)
    expected = [others[0], new, others[1]]
    for mine, one in zip(ensemble.each(state, action), expected, strict=True):
        torch.testing.assert_close(mine, one(state, action))


def test_it_is_built_again_from_its_config_and_weights():
    task = get_task("cartpole")
    one = HybridDynamics.hybrid(task, hidden_sizes=(8, 4), ensemble=3)
    other = HybridDynamics.from_config(task, one.config)
    assert isinstance(other.residual, EnsembleResidual)
    assert other.residual.members == 3
    other.load_state_dict(one.state_dict())
    state, action = draw(task, 20)
    assert torch.equal(other(state, action), one(state, action))


@pytest.mark.parametrize("members", [0, -1, 1.5])
def test_a_number_of_members_that_cannot_be_is_named(members):
    with pytest.raises(ConfigError, match=r"^members: expected "):
        EnsembleResidual(CartPole(), members)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "adam"])
def test_members_are_fitted_to_one_set_of_constants_and_differ(method):
    loss = make_loss(PENDULUM, model_options={"ensemble": 3, "hidden_sizes": (6,)})
    train, held_out = transitions(PENDULUM, 200), transitions(PENDULUM, 100, seed=1)
    before = loss(held_out)["loss_prediction"].item()
    start = [loss.dynamics.residual.member(k) for k in range(3)]
    config = FitConfig(method=method, steps=10, batch_size=None, learning_rate=1e-2)
    report = fit(loss, train, held_out, config, generator())
    assert report.held_out_error < 0.8 * before
    state, action = draw(PENDULUM, 50)
    each = loss.dynamics.residual.each(state, action)
    for k in range(3):
        assert (each[k] - each[k - 1]).abs().max() > 0
        fitted, first = loss.dynamics.residual.member(k), start[k]
        assert not torch.equal(fitted(state, action), first(state, action))


def test_the_first_member_and_the_constants_are_those_of_a_single_fit():
    train, held_out = transitions(PENDULUM, 150), transitions(PENDULUM, 100, seed=1)
    single = make_loss(PENDULUM, model_options={"hidden_sizes": (6,)})
    fit(single, train, held_out, SHORT, generator())
    several = make_loss(PENDULUM, model_options={"hidden_sizes": (6,), "ensemble": 2})
    report = fit(several, train, held_out, SHORT, generator())
    assert torch.equal(several.dynamics.prior.log_constants, single.dynamics.prior.log_constants)
    state, action = draw(PENDULUM, 50)
    first = several.dynamics.residual.member(0)
    torch.testing.assert_close(first(state, action), single.dynamics.residual(state, action))
    assert report.steps > 10  # of both members
    assert torch.equal(several.lambda_, single.lambda_)


def test_without_a_prior_members_are_fitted_alike():
    torch.manual_seed(0)
    loss = DynamicsLoss(HybridDynamics.data_driven(PENDULUM, hidden_sizes=(6,), ensemble=2))
    train, held_out = transitions(PENDULUM, 200), transitions(PENDULUM, 100, seed=1)
    before = loss(held_out)["loss_prediction"].item()
    assert fit(loss, train, held_out, SHORT, generator()).held_out_error < before


def test_members_part_where_the_data_end():
    """Trained where speeds are small, they disagree more about large ones."""
    loss = make_loss(PENDULUM, model_options={"ensemble": 4, "hidden_sizes": (8,)})
    data = transitions(PENDULUM, 400)
    slow = data[data["observation"][:, 2].abs() < 2.0]
    assert 20 < len(slow) < 300
    fit(loss, slow, slow, FitConfig(steps=20, batch_size=None), generator())
    state, action = draw(PENDULUM, 200)
    near, far = state.clone(), state.clone()
    near[:, 1], far[:, 1] = near[:, 1].clamp(-1, 1), 8.0
    spread = [loss.dynamics.residual.each(s, action).std(0)[:, 1].mean() for s in (near, far)]
    assert spread[1] > 3 * spread[0]
