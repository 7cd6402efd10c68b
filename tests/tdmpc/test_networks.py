"""TD-MPC's networks: their sizes, their units, and the model that planners plan in."""

from __future__ import annotations

import pytest
import torch
from lopsided import LOPSIDED

from phihp_torchrl import get_task
from phihp_torchrl.tasks import ActionBounds
from phihp_torchrl.tdmpc import TOLD, TOLDConfig

from .told_parts import SMALL, make_told

PUBLISHED = TOLDConfig(latent_dim=50, encoder_dim=256, mlp_dim=512)


def test_the_publications_sizes_and_initialisation():
    told = TOLD.for_task(get_task("cartpole"), PUBLISHED)
    widths = [tuple(p.shape) for p in told.dynamics.parameters() if p.ndim == 2]
    assert widths == [(512, 51), (512, 512), (50, 512)]
    assert [tuple(p.shape) for p in told.encoder.parameters() if p.ndim == 2] == [
        (256, 5),
        (50, 256),
    ]
    assert len(told.critics) == 2
    torch.testing.assert_close(told.dynamics[2].weight @ told.dynamics[2].weight.T, torch.eye(512))
    for network in (told.reward, *told.critics):
        assert not network[-1].weight.any()
    assert told.actor[-1].weight.any()
    linear = [m for m in told.modules() if isinstance(m, torch.nn.Linear)]
    assert not any(m.bias.any() for m in linear)
    assert told.termination is not None
    assert TOLD.for_task(get_task("pendulum")).termination is None


def test_twin_critics_differ_and_actions_are_in_physical_units():
    told = make_told()
    latent, action = torch.randn(5, 6), torch.randn(5, 1)
    values = told.q_values(latent, action)
    assert not torch.equal(values[0], values[1])
    assert torch.equal(told.twin_values(latent, action), values.T)
    noisy = told.policy(latent, torch.full((5, 1), 100.0))
    assert noisy.tolist() == [[2.0]] * 5
    half = TOLD(3, ActionBounds.from_limits([-1.0], [1.0]), SMALL, terminates=True)
    half.load_state_dict(told.state_dict())
    torch.testing.assert_close(half.q_values(latent, action / 2), values)


def test_bounds_are_only_a_unit_of_measure():
    """Same weights: an action of 2 N m there is one of 12 N m here, and -2 is -6."""
    told, lopsided = make_told(), make_told(seed=1, bounds=LOPSIDED.bounds)
    lopsided.load_state_dict(told.state_dict())
    latent, action = torch.randn(64, 6), 4 * torch.rand(64, 1) - 2
    moved = 3.0 + 4.5 * action
    torch.testing.assert_close(lopsided.policy(latent), 3.0 + 4.5 * told.policy(latent))
    torch.testing.assert_close(lopsided.q_values(latent, moved), told.q_values(latent, action))
    torch.testing.assert_close(lopsided.predict(latent, moved), told.predict(latent, action))
    for noise, limit in ((100.0, 12.0), (-100.0, -6.0)):
        assert (lopsided.policy(latent, torch.full((64, 1), noise)) == limit).all()


def test_bounds_are_no_weights_and_move_along():
    told = make_told(bounds=LOPSIDED.bounds)
    assert set(told.state_dict()) == {name for name, _ in told.named_parameters()}
    assert [limit.tolist() for limit in told.double().bounds] == [[-6.0], [12.0], [3.0], [9.0]]
    assert told.bounds.low.dtype == torch.float64


def test_a_model_that_never_terminates_says_so():
    told, latent = make_told(terminates=False), torch.randn(5, 6)
    _, _, terminated = told.transition(latent, torch.zeros(5, 1))
    assert terminated.dtype == torch.bool
    assert not terminated.any()
    assert told.termination_logit(latent) is None


def test_gradients_pass_the_clipping_of_noise():
    """At 0.76 of the bounds noise of 0.9 is clipped; the gradient is that of tanh all the same."""
    output = torch.tensor([[1.0]], requires_grad=True)
    action = make_told().squash(output, torch.tensor([[0.9]]))
    action.sum().backward()
    assert action.item() == pytest.approx(2.0)
    assert output.grad.item() == pytest.approx(2.0 / torch.cosh(torch.tensor(1.0)).item() ** 2)


@pytest.mark.parametrize("name", ["latent_dim", "encoder_dim", "mlp_dim"])
def test_bad_sizes_are_named(name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        TOLDConfig(**{name: 0})


@pytest.mark.parametrize("name", ["latent_dim", "encoder_dim", "mlp_dim"])
def test_sizes_that_no_memory_holds_are_named(name):
    with pytest.raises(ValueError, match=rf"^{name}: expected at most 65536, got 65537"):
        TOLDConfig(**{name: 65_537})
