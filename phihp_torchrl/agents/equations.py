"""TD3's equations as pure functions on tensors (Fujimoto et al., 2018, arXiv:1802.09477).

Everything here compiles into one graph. Networks are flat sequences of tensors ``(weight, bias,
weight, bias, …)``; those of the critics have a leading dimension of one entry for each critic, as
:class:`torchrl.objectives.TD3Loss` stacks them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from phihp_torchrl.imagination import Batch, Transit, finite_transition
from phihp_torchrl.tasks import ActionBounds

Layers = Sequence[Tensor]


def mlp(layers: Layers, inputs: Tensor) -> Tensor:
    """Evaluate a network with ReLU between its layers, ``[N, in] -> [N, out]``."""
    for i in range(0, len(layers) - 2, 2):
        inputs = F.linear(inputs, layers[i], layers[i + 1]).relu()
    if torch.is_autocast_enabled(inputs.device.type):
        # In bfloat16 the last layer would round a value of hundreds to whole numbers.
        with torch.autocast(inputs.device.type, enabled=False):
            return F.linear(inputs.to(layers[-2].dtype), layers[-2], layers[-1])
    return F.linear(inputs, layers[-2], layers[-1])


def prepare(layers: Layers) -> Callable[[Tensor], Tensor]:
    """Return :func:`mlp` of these layers as a function for many calls without gradients.

    It reads weights that are changed in place.
    """
    *hidden, last = zip(layers[::2], layers[1::2], strict=True)
    pairs = [(weight.t(), bias) for weight, bias in hidden]
    weight, bias = last[0].t(), last[1]

    def network(inputs: Tensor) -> Tensor:
        if inputs.ndim != 2 or torch.is_autocast_enabled(inputs.device.type):
            return mlp(layers, inputs)
        for each, shift in pairs:
            inputs = torch.addmm(shift, inputs, each).relu_()
        return torch.addmm(bias, inputs, weight)

    return network


def act(actor: Layers, observation: Tensor, bounds: ActionBounds) -> Tensor:
    """Evaluate the actor's layers: observations ``[N, o]`` to actions ``[N, m]`` in bounds.

    Args:
        actor: layers of the actor, ``(weight, bias, …)``.
        observation: observations ``[N, o]``.
        bounds: bounds of the action.

    Returns:
        Actions in physical units.

    Examples:
        >>> layers = [torch.zeros(1, 3), torch.full((1,), 100.0)]
        >>> bounds = ActionBounds.from_limits([0.0], [12.0])
        >>> act(layers, torch.zeros(2, 3), bounds).flatten()
        tensor([12., 12.])
    """
    return bounds.from_unit(mlp(actor, observation).tanh())


def q_values(critics: Layers, observation: Tensor, action: Tensor, bounds: ActionBounds) -> Tensor:
    """Evaluate all critics: observations ``[N, o]``, actions ``[N, m]`` to ``[critics, N]``."""
    inputs = torch.cat([observation, bounds.to_unit(action)], -1)
    # One critic at a time: batched products are not faster at these sizes, and prevent fusion.
    apart = zip(*(layer.unbind() for layer in critics), strict=True)
    return torch.stack([mlp(critic, inputs).squeeze(-1) for critic in apart])


def td3_target(
    batch: Batch,
    actor: Layers,
    critics: Layers,
    noise: Tensor,
    bounds: ActionBounds,
    gamma: float,
    observe: Callable[[Tensor], Tensor],
    transition: Transit | None = None,
    expansion: int = 1,
) -> Tensor:
    r"""Compute the target of the critics, ``[N]``.

    .. math::
        y = \sum_{i<k} \gamma^i r_i + \gamma^k \min_j Q'_j(s_k, \mathrm{clip}(\pi'(s_k) + \epsilon))

    where rewards and values after a termination are 0. The first reward is that of the batch; with
    ``expansion`` k > 1 the model continues for k - 1 steps under the target policy (model-based
    value expansion, Feinberg et al., 2018, arXiv:1803.00101).

    Args:
        batch: transitions.
        actor: target actor.
        critics: target critics.
        noise: target policy noise, clipped, in physical units, ``[N, m]``.
        bounds: the action's bounds.
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
        action = act(actor, observe(state), bounds)
        state, reward, terminated = finite_transition(transition, state, action)
        value = value + discount * reward
        discount = gamma * discount * (1.0 - terminated.to(value.dtype))
    observation = observe(state)
    action = bounds.clip(act(actor, observation, bounds) + noise)
    return value + discount * q_values(critics, observation, action, bounds).amin(0)


def critic_loss(
    critics: Layers, observation: Tensor, action: Tensor, target: Tensor, bounds: ActionBounds
) -> Tensor:
    """The squared errors of the critics, summed over critics and averaged over the batch."""
    error = q_values(critics, observation, action, bounds) - target
    return error.square().sum(0).mean()


SATURATED = 2.0
"""Output of an actor before its tanh, from which on a price may be set: 96 % of the half-range."""


def actor_loss(
    actor: Layers,
    critics: Layers,
    observation: Tensor,
    bounds: ActionBounds,
    saturation_cost: float = 0.0,
    change_cost: float = 0.0,
    next_observation: Tensor | None = None,
) -> Tensor:
    r"""-Q1(s, pi(s)), averaged over the batch, and prices of saturated and of restless outputs.

    .. math::
        -\overline{Q_1(s, \pi(s))} + \sigma(Q_1) \left( c_s\, \overline{\max(|u| - 2, 0)^2}
        + c_\Delta\, \overline{(\tanh u' - \tanh u)^2} \right)

    u is the actor's output before its tanh. Where that is far out, the slope of tanh is 0, and no
    value that the critics find later reaches the actor any more (Wang et al., 2020,
    arXiv:1910.02208). u' is its output in the next state, which an actor that is driven to and fro
    changes much for little (Mysore et al., 2021, arXiv:2012.06644).

    Args:
        actor: layers of the actor.
        critics: layers of the critics, of which the first is used.
        observation: observations ``[N, o]``.
        bounds: bounds of the action.
        saturation_cost: the first price, in standard deviations σ of the values of the batch.
        change_cost: the second price, in the same units.
        next_observation: observations after the batch's transitions, ``[N, o]``, for that.
    """
    output = mlp(actor, observation)
    unit = output.tanh()
    first = [layer[:1] for layer in critics]
    value = q_values(first, observation, bounds.from_unit(unit), bounds)
    loss = -value.mean()
    if saturation_cost:
        beyond = (output.abs() - SATURATED).clamp_min(0.0)
        scale = value.detach().std(correction=0)
        loss = loss + saturation_cost * scale * beyond.square().mean()
    if change_cost and next_observation is not None:
        change = mlp(actor, next_observation).tanh() - unit
        scale = value.detach().std(correction=0)
        loss = loss + change_cost * scale * change.square().mean()
    return loss


ADAM_BETAS = (0.9, 0.999)
"""Decay rates of Adam's first and second moments."""


def adam_rates(
    step: Tensor,
    learning_rate: float,
    eps: float = 1e-8,
    betas: tuple[float, float] = ADAM_BETAS,
) -> tuple[Tensor, Tensor]:
    """Compute the two scalars of a step of Adam that do not depend on the gradient.

    They are computed once a step, outside :func:`adam_`, rather than once for each tensor.

    Args:
        step: number of this step, from 1, any shape.
        learning_rate: learning rate.
        eps: the term that :class:`torch.optim.Adam` adds to the denominator.
        betas: decay rates of the moments.

    Returns:
        The step size, and the term to add to the root of the second moment, both float32.
    """
    step = step.to(torch.float64)
    beta1, beta2 = betas
    root = (1.0 - beta2**step).sqrt()
    size = learning_rate * root / (1.0 - beta1**step)
    return size.to(torch.float32), (eps * root).to(torch.float32)


def adam_(
    params: Layers,
    grads: Layers,
    means: Layers,
    squares: Layers,
    size: Tensor,
    eps: Tensor,
    *,
    betas: tuple[float, float] = ADAM_BETAS,
) -> None:
    """Take one step of Adam in place, as :class:`torch.optim.Adam` defines it.

    Args:
        params: parameters, changed in place.
        grads: gradients.
        means: first moments, changed in place.
        squares: second moments, changed in place.
        size: scalar of :func:`adam_rates`.
        eps: scalar of :func:`adam_rates`.
        betas: decay rates of the moments, those of :func:`adam_rates`.
    """
    beta1, beta2 = betas
    for param, grad, mean, square in zip(params, grads, means, squares, strict=True):
        mean.lerp_(grad, 1.0 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
        param.sub_(size * mean / (square.sqrt() + eps))


def soft_update_(targets: Layers, sources: Layers, tau: float) -> None:
    """Move the targets in place: targets ← (1 - tau) targets + tau sources."""
    for target, source in zip(targets, sources, strict=True):
        target.lerp_(source, tau)
