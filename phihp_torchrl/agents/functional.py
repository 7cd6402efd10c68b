"""TD3's equations as pure functions on tensors (Fujimoto et al., 2018, arXiv:1802.09477).

Everything here compiles into one graph. Networks are flat sequences of tensors ``(weight, bias,
weight, bias, …)``; those of the critics carry a leading dimension, one entry a critic, as
:class:`torchrl.objectives.TD3Loss` stacks them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

Layers = Sequence[Tensor]
Transition = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""``state, action -> next_state, reward, terminated`` (see ``TaskWorldModel.transition``)."""


class Batch(NamedTuple):
    """Transitions, one a row."""

    state: Tensor
    """``[N, n]``."""
    action: Tensor
    """Physical units, ``[N, m]``."""
    reward: Tensor
    """``[N]``."""
    next_state: Tensor
    """``[N, n]``."""
    terminated: Tensor
    """bool ``[N]``."""


def mlp(layers: Layers, inputs: Tensor) -> Tensor:
    """A network with ReLU between its layers, ``[N, in] -> [N, out]``."""
    for i in range(0, len(layers) - 2, 2):
        inputs = F.linear(inputs, layers[i], layers[i + 1]).relu()
    if torch.is_autocast_enabled(inputs.device.type):
        # The rest in half the precision would round a value of hundreds to whole numbers.
        with torch.autocast(inputs.device.type, enabled=False):
            return F.linear(inputs.to(layers[-2].dtype), layers[-2], layers[-1])
    return F.linear(inputs, layers[-2], layers[-1])


def policy(actor: Layers, observation: Tensor, action_high: Tensor) -> Tensor:
    """The actor: ``[N, o] -> [N, m]``, physical units."""
    return mlp(actor, observation).tanh() * action_high


def q_values(critics: Layers, observation: Tensor, action: Tensor, action_high: Tensor) -> Tensor:
    """All critics: ``[N, o], [N, m] -> [critics, N]``."""
    inputs = torch.cat([observation, action / action_high], -1)
    # One by one: batched products are no faster at these sizes, and leave no room for fusion.
    apart = zip(*(layer.unbind() for layer in critics), strict=True)
    return torch.stack([mlp(critic, inputs).squeeze(-1) for critic in apart])


def finite_transition(
    transition: Transition, state: Tensor, action: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """A step of the model; one into non-finite numbers stays put, earns nothing and terminates."""
    next_state, reward, terminated = transition(state, action)
    finite = next_state.isfinite().all(-1) & reward.isfinite()
    next_state = torch.where(finite.unsqueeze(-1), next_state, state)
    return next_state, torch.where(finite, reward, torch.zeros_like(reward)), terminated | ~finite


def td3_target(
    batch: Batch,
    actor: Layers,
    critics: Layers,
    noise: Tensor,
    action_high: Tensor,
    gamma: float,
    observe: Callable[[Tensor], Tensor],
    transition: Transition | None = None,
    expansion: int = 1,
) -> Tensor:
    r"""The value that the critics should have, ``[N]``.

    .. math::
        y = \sum_{i<k} \gamma^i r_i + \gamma^k \min_j Q'_j(s_k, \mathrm{clip}(\pi'(s_k) + \epsilon))

    with nothing after a termination. The first reward is the batch's; with ``expansion`` k > 1 the
    model carries on for k - 1 steps under the target policy (model-based value expansion, Feinberg
    et al., 2018, arXiv:1803.00101).

    Args:
        batch: transitions.
        actor: target actor.
        critics: target critics.
        noise: target policy noise, clipped, in physical units, ``[N, m]``.
        action_high: action bounds ``[m]``.
        gamma: discount.
        observe: state -> observation.
        transition: the model, needed for ``expansion`` > 1.
        expansion: number of rewards in the sum, k.

    Raises:
        ValueError: for ``expansion`` > 1 without ``transition``.
    """
    value = batch.reward
    state = batch.next_state
    alive = 1.0 - batch.terminated.to(value.dtype)
    discount = gamma * alive
    for _ in range(expansion - 1):
        if transition is None:
            raise ValueError(f"transition: expected the model for expansion={expansion}, got none.")
        action = policy(actor, observe(state), action_high)
        state, reward, terminated = finite_transition(transition, state, action)
        value = value + discount * reward
        discount = gamma * discount * (1.0 - terminated.to(value.dtype))
    observation = observe(state)
    action = policy(actor, observation, action_high) + noise
    action = torch.minimum(torch.maximum(action, -action_high), action_high)
    return value + discount * q_values(critics, observation, action, action_high).amin(0)


def critic_loss(
    critics: Layers, observation: Tensor, action: Tensor, target: Tensor, action_high: Tensor
) -> Tensor:
    """Squared errors of all critics, summed over critics and averaged over the batch."""
    error = q_values(critics, observation, action, action_high) - target
    return error.square().sum(0).mean()


def actor_loss(actor: Layers, critics: Layers, observation: Tensor, action_high: Tensor) -> Tensor:
    """-Q1(s, pi(s)), averaged over the batch."""
    action = policy(actor, observation, action_high)
    first = [layer[:1] for layer in critics]
    return -q_values(first, observation, action, action_high).mean()


ADAM_BETAS = (0.9, 0.999)
"""Decay of Adam's first and second moments."""


def adam_rates(step: Tensor, learning_rate: float, eps: float = 1e-8) -> tuple[Tensor, Tensor]:
    """The two scalars of a step of Adam that do not depend on the gradient.

    They are apart from :func:`adam_` to be computed once a step rather than once an element.

    Args:
        step: number of this step, from 1, any shape.
        learning_rate: learning rate.
        eps: what :class:`torch.optim.Adam` adds to the denominator.

    Returns:
        Size of the step and what to add to the root of the second moment, float32.
    """
    step = step.to(torch.float64)
    beta1, beta2 = ADAM_BETAS
    root = (1.0 - beta2**step).sqrt()
    size = learning_rate * root / (1.0 - beta1**step)
    return size.to(torch.float32), (eps * root).to(torch.float32)


def adam_(
    params: Layers, grads: Layers, means: Layers, squares: Layers, size: Tensor, eps: Tensor
) -> None:
    """One step of Adam in place, as :class:`torch.optim.Adam` defines it.

    Args:
        params: what to change.
        grads: gradients.
        means: first moments, changed in place.
        squares: second moments, changed in place.
        size: scalar of :func:`adam_rates`.
        eps: scalar of :func:`adam_rates`.
    """
    beta1, beta2 = ADAM_BETAS
    for param, grad, mean, square in zip(params, grads, means, squares, strict=True):
        mean.lerp_(grad, 1.0 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
        param.sub_(size * mean / (square.sqrt() + eps))


def soft_update_(targets: Layers, sources: Layers, tau: float) -> None:
    """Move the targets in place: targets ← (1 - tau) targets + tau sources."""
    for target, source in zip(targets, sources, strict=True):
        target.lerp_(source, tau)
