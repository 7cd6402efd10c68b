"""One gradient step of TD-MPC: rates, clipping, targets, resuming, and that it learns."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl.tasks import ActionBounds
from phihp_torchrl.tdmpc import TOLD, TDMPCConfig, TDMPCLossConfig, TDMPCUpdate, TOLDConfig

from .told_parts import make_slices, make_told


def test_targets_follow_every_other_update():
    update = TDMPCUpdate(make_told(), TDMPCConfig(tau=0.25, target_interval=2))

    def parameters(told):
        return [
            p.detach().clone() for net in (told.encoder, told.critics) for p in net.parameters()
        ]

    start = parameters(update.loss.target)
    update(make_slices())
    assert all(map(torch.equal, start, parameters(update.loss.target)))
    update(make_slices(seed=1))
    now = parameters(update.loss.told)
    for old, target, new in zip(start, parameters(update.loss.target), now, strict=True):
        torch.testing.assert_close(target, 0.75 * old + 0.25 * new)


@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_rates_and_their_scale(scale):
    """Adam's first step is the rate, whatever the gradient."""
    config = TDMPCConfig(learning_rate=1e-2, critic_learning_rate=1e-4)
    told = make_told()
    before = {name: p.clone() for name, p in told.named_parameters()}
    TDMPCUpdate(told, config)(make_slices(), scale)
    for name, p in told.named_parameters():
        step = (p - before[name]).abs().max().item()
        rate = 1e-4 if name.startswith("critics") else 1e-2
        assert step == pytest.approx(scale * rate, rel=0.02), name


def test_gradients_are_clipped_for_model_and_policy_apart():
    update = TDMPCUpdate(make_told(), TDMPCConfig(max_grad_norm=1e-3))
    update(make_slices())
    for parameters in update._clipped:
        norm = torch.stack([p.grad.norm() for p in parameters]).norm()
        assert norm.item() == pytest.approx(1e-3, rel=1e-3)


def test_an_update_goes_on_from_its_state():
    ours, theirs = (TDMPCUpdate(make_told(seed), TDMPCConfig()) for seed in (0, 1))
    for seed in range(3):
        ours(make_slices(seed=seed), generator=torch.Generator().manual_seed(seed))
    theirs.load_state_dict(ours.state_dict())
    for update in (ours, theirs):
        update(make_slices(seed=9), generator=torch.Generator().manual_seed(9))
    for a, b in zip(ours.loss.parameters(), theirs.loss.parameters(), strict=True):
        assert torch.equal(a, b)


def test_learning_beyond_chance_on_a_tiny_problem():
    """One step, reward -(a - o)^2: the best action is the observation, here within ±1."""
    torch.manual_seed(0)
    sizes = TOLDConfig(latent_dim=4, encoder_dim=16, mlp_dim=32)
    told = TOLD(1, ActionBounds.from_limits([-1.0], [1.0]), sizes, terminates=True)
    config = TDMPCConfig(loss=TDMPCLossConfig(value_coef=1.0))
    update = TDMPCUpdate(told, config)
    generator = torch.Generator().manual_seed(0)
    for _ in range(250):
        observation, action = (2 * torch.rand(64, 1, 1, generator=generator) - 1 for _ in range(2))
        update(
            TensorDict(
                observation=observation,
                action=action,
                valid=torch.ones(64, 1, dtype=torch.bool),
                next=TensorDict(
                    observation=observation,
                    reward=-(action - observation).square(),
                    terminated=torch.ones(64, 1, 1, dtype=torch.bool),
                    batch_size=[64, 1],
                ),
                batch_size=[64, 1],
            ),
            generator=generator,
        )
    observation = torch.linspace(-0.9, 0.9, 50).unsqueeze(-1)
    error = (told.policy(told.encode(observation)) - observation).square().mean()
    assert error < 0.05  # doing nothing costs 0.28, acting at random 0.6
    _, _, terminated = told.transition(told.encode(observation), torch.zeros(50, 1))
    assert terminated.all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learning_rate", 0.0),
        ("critic_learning_rate", torch.inf),
        ("max_grad_norm", 0.0),
        ("tau", 0.0),
        ("tau", 1.5),
        ("target_interval", 0),
    ],
)
def test_config_errors_name_the_key(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        TDMPCConfig(**{name: value})
