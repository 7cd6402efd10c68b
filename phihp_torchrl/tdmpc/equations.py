"""TD-MPC's equations as functions on tensors (Hansen et al., 2022, section 4, equations 6 to 9).

Slices are ``[N, H, ...]``: ``N`` of them, each ``H`` transitions long. Transitions that come after
the end of an episode are padding, finite but meaningless, and ``valid`` ``[N, H]`` is false there:
they do not enter any loss.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from phihp_torchrl.tdmpc.networks import TOLD


class Slices(NamedTuple):
    """Transitions in their order."""

    observation: Tensor
    """``[N, H, o]``."""
    action: Tensor
    """Physical units, ``[N, H, m]``."""
    reward: Tensor
    """``[N, H]``."""
    next_observation: Tensor
    """``[N, H, o]``."""
    terminated: Tensor
    """bool ``[N, H]``."""
    valid: Tensor
    """Whether a transition happened, or is padding after the end; bool ``[N, H]``."""


class ModelLosses(NamedTuple):
    """The losses of the model, one of each a slice, ``[N]``."""

    consistency: Tensor
    reward: Tensor
    value: Tensor
    termination: Tensor
    td_error: Tensor
    """Absolute errors of both critics, without gradients: the priority of the slice."""


@torch.no_grad()
def td_target(told: TOLD, target: TOLD, slices: Slices, noise: Tensor, gamma: float) -> Tensor:
    r"""Compute the target of the critics, ``[N, H]``.

    .. math::
        y_t = r_t + \gamma\, (1 - \text{terminated}_t) \min_j Q^-_j(z_{t+1}, \pi(z_{t+1})),
        \qquad z_{t+1} = h(o_{t+1})

    The policy and the encoder are the current ones, the critics are the targets.

    Args:
        told: the networks.
        target: their targets.
        slices: transitions.
        noise: on the policy's action, in units of its half-range, ``[N, H, m]``.
        gamma: discount.
    """
    latent = told.encode(slices.next_observation)
    value = target.q_values(latent, told.policy(latent, noise)).amin(0)
    return slices.reward + gamma * torch.where(slices.terminated, torch.zeros_like(value), value)


def temporal_weights(valid: Tensor, rho: float) -> Tensor:
    r"""Weight :math:`\rho^t` of each transition, and 0 of padding, ``[N, H]``."""
    steps = torch.arange(valid.shape[-1], dtype=torch.float32, device=valid.device)
    return torch.where(valid, rho**steps, 0.0)


def model_losses(
    told: TOLD, target: TOLD, slices: Slices, value_target: Tensor, rho: float
) -> tuple[ModelLosses, Tensor]:
    r"""The losses along the latent that unrolls from the first observation of each slice.

    With weights :math:`w_t` of :func:`temporal_weights` and :math:`z_0 = h(o_0)`,
    :math:`z_{t+1} = d(z_t, a_t)`:

    .. math::
        \sum_t w_t \lVert z_{t+1} - h^-(o_{t+1}) \rVert^2 / l, \quad
        \sum_t w_t (R(z_t, a_t) - r_t)^2, \quad
        \sum_t w_t \sum_j (Q_j(z_t, a_t) - y_t)^2

    and, where episodes can terminate, the cross-entropy of that in :math:`z_{t+1}`.

    Args:
        told: the networks; gradients reach all but the policy.
        target: their targets; no gradients.
        slices: transitions.
        value_target: :func:`td_target`, ``[N, H]``.
        rho: temporal weight.

    Returns:
        The losses, and the latents ``[N, H + 1, l]``.
    """
    weights = temporal_weights(slices.valid, rho)
    with torch.no_grad():
        next_latents = target.encode(slices.next_observation)
    latent = told.encode(slices.observation[:, 0])
    latents = [latent]
    total = ModelLosses(*(torch.zeros_like(weights[:, 0]) for _ in range(5)))
    for t in range(weights.shape[1]):
        values = told.q_values(latent, slices.action[:, t])
        latent, reward = told.predict(latent, slices.action[:, t])
        latents.append(latent)
        logit = told.termination_logit(latent)
        error = values - value_target[:, t]
        steps = ModelLosses(
            consistency=(latent - next_latents[:, t]).square().mean(-1),
            reward=(reward - slices.reward[:, t]).square(),
            value=error.square().sum(0),
            termination=torch.zeros_like(reward)
            if logit is None
            else F.binary_cross_entropy_with_logits(
                logit, slices.terminated[:, t].to(logit.dtype), reduction="none"
            ),
            td_error=error.detach().abs().sum(0),
        )
        total = ModelLosses(
            *(so_far + weights[:, t] * step for so_far, step in zip(total, steps, strict=True))
        )
    return total, torch.stack(latents, 1)


def policy_loss(
    told: TOLD,
    latents: Tensor,
    slices: Slices,
    noise: Tensor,
    rho: float,
    output_penalty: float = 0.0,
) -> Tensor:
    r"""Compute the loss of the policy, its negative value by the critics, a scalar.

    .. math::
        -\sum_{t=0}^{H} \rho^t \Big(\min_j Q_j(\bar z_t, \pi(\bar z_t))
        - c\, \lVert \tanh^{-1} \pi(\bar z_t) \rVert^2\Big)

    averaged over the slices. Gradients reach the policy alone: the latents are detached and the
    critics held. A latent after a termination does not count.

    Args:
        told: the networks.
        latents: ``[N, H + 1, l]``.
        slices: transitions.
        noise: on the policy's action, in units of its half-range, ``[N, H + 1, m]``.
        rho: temporal weight.
        output_penalty: weight :math:`c` of the outputs before tanh. Where tanh is flat the critics'
            gradients do not reach the policy any more; this brings it back. Not in the publication.
    """
    latents = latents.detach()
    # The latent that a transition leads to counts if the episode goes on from there.
    goes_on = slices.valid & ~slices.terminated
    counts = torch.cat([torch.ones_like(goes_on[:, :1]), goes_on], 1)
    output = told.actor(latents)
    value = told.q_values(latents, told.squash(output, noise), held=True).amin(0)
    value = value - output_penalty * output.square().sum(-1)
    weights = temporal_weights(counts, rho)
    return -(weights * value).sum(1).mean()
