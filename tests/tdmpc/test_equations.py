"""TD-MPC's targets and losses by hand, on networks that are sums."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from phihp_torchrl.tdmpc.equations import (
    Slices,
    model_losses,
    policy_loss,
    td_target,
    temporal_weights,
)

from .told_parts import make_slices, make_told


class LinearTOLD:
    """Latents are observations of one number; everything else is linear, for sums by hand."""

    def __init__(self, shift=0.0):
        self.shift = shift

    def encode(self, observation):
        return observation + self.shift

    def actor(self, latent):
        return 0.5 * latent

    def squash(self, output, noise=None):
        return output + (0.0 if noise is None else noise)

    def policy(self, latent, noise=None):
        return self.squash(self.actor(latent), noise)

    def predict(self, latent, action):
        return latent + action, (2 * latent).squeeze(-1)

    def q_values(self, latent, action, held=False):
        return torch.stack([latent + action + self.shift, 3 * latent]).squeeze(-1)

    def termination_logit(self, latent):
        return None


def hand_slices(terminated=(False, False), valid=(True, True)):
    """Observations 1, 2, 4; actions 1, 2; rewards 10, 20."""
    return Slices(
        observation=torch.tensor([[[1.0], [2.0]]]),
        action=torch.tensor([[[1.0], [2.0]]]),
        reward=torch.tensor([[10.0, 20.0]]),
        next_observation=torch.tensor([[[2.0], [4.0]]]),
        terminated=torch.tensor([terminated]),
        valid=torch.tensor([valid]),
    )


def test_targets_by_hand():
    """In 2 and 4 the policy does 1 and 2, the targets say 3 and 6 plus 1 (6 and 12: too much)."""
    noise = torch.zeros(1, 2, 1)
    target = SimpleNamespace(q_values=LinearTOLD(1.0).q_values)
    y = td_target(LinearTOLD(), target, hand_slices(), noise, gamma=0.5)
    assert y.tolist() == [[10 + 0.5 * 4, 20 + 0.5 * 7]]
    y = td_target(LinearTOLD(), target, hand_slices((False, True)), noise, gamma=0.5)
    assert y.tolist() == [[10 + 0.5 * 4, 20.0]]
    y = td_target(LinearTOLD(), target, hand_slices(), noise + 0.25, gamma=0.5)
    assert y.tolist() == [[10 + 0.5 * 4.25, 20 + 0.5 * 7.25]]


def test_model_losses_by_hand():
    """Latents 1, 2, 4, target latents 3, 5; rewards 2, 4; values 2, 3 and 4, 6."""
    target = LinearTOLD(1.0)
    y = torch.tensor([[3.0, 5.0]])
    losses, latents = model_losses(LinearTOLD(), target, hand_slices(), y, rho=0.5)
    assert latents.flatten().tolist() == [1.0, 2.0, 4.0]
    assert losses.consistency.item() == 1 + 0.5 * 1
    assert losses.reward.item() == 64 + 0.5 * 256
    assert losses.value.item() == (1 + 0) + 0.5 * (1 + 1)
    assert losses.td_error.item() == (1 + 0) + 0.5 * (1 + 1)
    assert losses.termination.item() == 0.0
    short = hand_slices((True, False), (True, False))
    losses, _ = model_losses(LinearTOLD(), target, short, y, rho=0.5)
    assert [x.item() for x in losses] == [1.0, 64.0, 1.0, 0.0, 1.0]


def test_policy_loss_by_hand():
    """In 1, 2, 4 the critics say 1.5, 3 and 6 of the policy's action, and 3, 6, 12."""
    latents = torch.tensor([[[1.0], [2.0], [4.0]]])
    noise = torch.zeros(1, 3, 1)

    def loss(*args, **kwargs):
        return policy_loss(LinearTOLD(), latents, hand_slices(*args), noise, 0.5, **kwargs).item()

    assert loss() == -(1.5 + 0.5 * 3 + 0.25 * 6)
    assert loss((False, True)) == -(1.5 + 0.5 * 3)  # the last latent is beyond the end
    assert loss((True, False), (True, False)) == -1.5
    penalty = 0.5**2 + 0.5 * 1**2 + 0.25 * 2**2
    assert loss(output_penalty=0.5) == loss() + 0.5 * penalty


def test_termination_loss_is_the_cross_entropy_along_the_slice():
    told, slices = make_told(), make_slices(1, 2)
    slices["next", "terminated"][0, 1] = True
    typed = Slices(
        slices["observation"],
        slices["action"],
        slices["next", "reward"][..., 0],
        slices["next", "observation"],
        slices["next", "terminated"][..., 0],
        slices["valid"],
    )
    losses, latents = model_losses(told, told, typed, torch.zeros(1, 2), rho=0.5)
    p = told.termination_logit(latents[0, 1:]).sigmoid()
    expected = -(1 - p[0]).log() - 0.5 * p[1].log()
    torch.testing.assert_close(losses.termination[0], expected)


def test_temporal_weights():
    valid = torch.tensor([[True, True, True], [True, False, False]])
    assert temporal_weights(valid, 0.5).tolist() == [[1.0, 0.5, 0.25], [1.0, 0.0, 0.0]]
