"""TDMPCLoss: whom its gradients reach, what counts, and its keys."""

from __future__ import annotations

import pytest
import torch
from lopsided import LOPSIDED

from phihp_torchrl.tdmpc import TDMPCLoss, TDMPCLossConfig

from .told_parts import make_slices, make_told

NETWORKS = ("encoder", "dynamics", "reward", "critics", "actor", "termination")


def gradients(loss, told):
    told.zero_grad()
    loss.backward()
    return {
        name
        for name in NETWORKS
        if any(p.grad is not None and p.grad.any() for p in getattr(told, name).parameters())
    }


def test_gradients_reach_what_they_must_and_nothing_else():
    told, slices = make_told(), make_slices()
    slices["next", "terminated"][0, 2] = True
    loss = TDMPCLoss(told, TDMPCLossConfig())
    generator = torch.Generator().manual_seed(0)
    losses = loss(slices, generator)
    assert gradients(losses["loss_policy"], told) == {"actor"}
    losses = loss(slices, generator)
    assert gradients(losses["loss_model"], told) == set(NETWORKS) - {"actor"}
    assert all(p.grad is None and not p.requires_grad for p in loss.target.parameters())
    assert not any(losses[k].requires_grad for k in ("td_error", "loss_value", "loss_reward"))


@pytest.mark.parametrize("only", ["consistency", "reward", "value", "termination"])
def test_each_loss_trains_its_own_networks(only):
    """The value's target is fixed: with the value loss alone neither dynamics nor encoder of the
    next observation matter beyond the unrolled latent, and the policy gets nothing."""
    names = ("consistency", "reward", "value", "termination")
    config = TDMPCLossConfig(**{f"{name}_coef": float(name == only) for name in names})
    told = make_told()
    found = gradients(TDMPCLoss(told, config)(make_slices())["loss_model"], told)
    head = {"reward": "reward", "value": "critics", "termination": "termination"}.get(only)
    assert found == {"encoder", "dynamics", *([head] if head else [])}


def test_padding_counts_nowhere():
    told, slices = make_told(), make_slices()
    slices["valid"][:, 2] = False
    slices["next", "terminated"][:, 1] = True
    loss = TDMPCLoss(told, TDMPCLossConfig())
    results = []
    for value in (0.0, 7.0):
        for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
            slices[key][:, 2] = value
        told.zero_grad()
        losses = loss(slices, torch.Generator().manual_seed(0))
        (losses["loss_model"] + losses["loss_policy"]).backward()
        results.append([losses["td_error"], *(p.grad.clone() for p in told.parameters())])
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_importance_weights_weigh_slices():
    told, slices = make_told(), make_slices()
    loss = TDMPCLoss(told, TDMPCLossConfig(policy_noise=0.0))
    each = [loss(slices[i : i + 1])["loss_model"] for i in range(4)]
    weight = torch.tensor([1.0, 0.5, 0.25, 0.0])
    slices["priority_weight"] = weight[:, None].expand(4, 3)
    torch.testing.assert_close(loss(slices)["loss_model"], (weight * torch.stack(each)).mean())


def test_losses_do_not_depend_on_the_unit_of_the_action():
    told, lopsided = make_told(), make_told(bounds=LOPSIDED.bounds)
    slices = make_slices()
    moved = slices.clone().set("action", 3.0 + 4.5 * slices["action"])
    config, losses = TDMPCLossConfig(policy_noise=0.5), []
    for network, data in ((told, slices), (lopsided, moved)):
        losses.append(TDMPCLoss(network, config)(data, torch.Generator().manual_seed(0)))
    torch.testing.assert_close(*(dict(found.items()) for found in losses))


def test_keys_can_be_set():
    slices = make_slices().rename_key_("action", "torque")
    loss = TDMPCLoss(make_told(), TDMPCLossConfig())
    loss.set_keys(action="torque")
    assert "torque" in loss.in_keys
    assert loss(slices)["loss_model"].isfinite()


@pytest.mark.slow
@pytest.mark.usefixtures("traced")
def test_compiled_and_eager_losses_agree():
    results = []
    for compile in (False, True):
        told = make_told()
        losses = TDMPCLoss(told, TDMPCLossConfig(), compile=compile)(
            make_slices(horizon=2), torch.Generator().manual_seed(0)
        )
        (losses["loss_model"] + losses["loss_policy"]).backward()
        results.append([losses["td_error"], *(p.grad for p in told.parameters())])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gamma", 0.0),
        ("gamma", 1.1),
        ("rho", 0.0),
        ("consistency_coef", -1.0),
        ("reward_coef", -1.0),
        ("value_coef", torch.nan),
        ("termination_coef", -1.0),
        ("policy_noise", -0.1),
        ("output_penalty", -0.1),
    ],
)
def test_config_errors_name_the_key(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        TDMPCLossConfig(**{name: value})
