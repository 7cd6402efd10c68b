r"""Policy gradients through the model, as pure functions (SHAC, arXiv:2204.07137).

The model is differentiable, so the gradient of an imagined return needs no estimate from samples:
it is carried back through the steps of the model. With :math:`G_t = r_t + \gamma G_{t+1}` up to the
horizon and the critic's value beyond it, the adjoint :math:`\lambda_t = \partial G_t / \partial
s_t` obeys

.. math::
    g_t = \frac{\partial r_t}{\partial a_t}
        + \gamma \frac{\partial s_{t+1}}{\partial a_t}^\top \lambda_{t+1}, \qquad
    \lambda_t = \frac{\partial r_t}{\partial s_t}
        + \gamma \frac{\partial s_{t+1}}{\partial s_t}^\top \lambda_{t+1}
        + \frac{\partial \pi}{\partial s_t}^\top g_t

and the actor follows :math:`\sum_t \frac{\partial \pi}{\partial \theta}^\top g_t`. Where the system
is chaotic, products of Jacobians grow exponentially and say nothing of the return any more. So each
:math:`g_t` is limited, row by row and step by step, before it goes further back
(:func:`pull_step`).

Critics learn TD(λ) returns by TorchRL's ``td_lambda_return_estimate``, which compiles.
Its vectorised form does not compile (torchrl 0.14.1). The
``DreamerActorLoss`` of TorchRL is not used: it knows no terminations, and gradients cannot be
limited on their way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import vjp
from torch.nn import functional as F
from torchrl.objectives.value.functional import td_lambda_return_estimate

from phihp_torchrl.agents.equations import Layers, act, mlp, q_values
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import finite_transition
from phihp_torchrl.tasks import ActionBounds


class Imagined(NamedTuple):
    """A step of many imagined worlds under the noisy actor."""

    action: Tensor
    """Actions in physical units, ``[N, m]``."""
    reward: Tensor
    """Rewards, ``[N]``."""
    next_state: Tensor
    """States after the step, ``[N, n]``."""
    terminated: Tensor
    """Whether the step ended the episode, bool ``[N]``."""


def noisy_action(actor: Layers, observation: Tensor, noise: Tensor, bounds: ActionBounds) -> Tensor:
    """The actor's action with noise before its tanh, ``[N, m]``: inside the bounds and smooth.

    Args:
        actor: layers of the actor.
        observation: observations ``[N, o]``.
        noise: noise ``[N, m]``, in units of the action's half-range near its middle.
        bounds: bounds of the action.
    """
    return bounds.from_unit((mlp(actor, observation) + noise).tanh())


def imagine_step(
    world_model: TaskWorldModel, actor: Layers, state: Tensor, noise: Tensor, bounds: ActionBounds
) -> Imagined:
    """Step worlds ``[N, n]`` once; one that leaves the finite numbers terminates where it is."""
    action = noisy_action(actor, world_model.observe(state), noise, bounds)
    next_state, reward, terminated = finite_transition(world_model.transition, state, action)
    return Imagined(action, reward, next_state, terminated)


def state_values(
    world_model: TaskWorldModel, actor: Layers, critics: Layers, state: Tensor, bounds: ActionBounds
) -> Tensor:
    """Values ``[N]`` of states ``[N, n]``: the mean of the critics at the actor's action."""
    observation = world_model.observe(state)
    return q_values(critics, observation, act(actor, observation, bounds), bounds).mean(0)


def lambda_returns(
    reward: Tensor, next_value: Tensor, terminated: Tensor, gamma: float, trace: float
) -> Tensor:
    r"""TD(λ) returns of imagined steps, ``[H, N]``, the last of which goes on with its value.

    .. math::
        G_t = r_t + \gamma (1 - d_t) \bigl((1 - \lambda) V(s_{t+1}) + \lambda G_{t+1}\bigr)

    Args:
        reward: rewards ``[H, N]``.
        next_value: values of the states after the steps, ``[H, N]``.
        terminated: whether a step ended the episode, bool ``[H, N]``; the next row is then a new
            one.
        gamma: discount.
        trace: λ.
    """
    parts = (part.mT.unsqueeze(-1) for part in (next_value, reward, terminated, terminated))
    return td_lambda_return_estimate(gamma, trace, *parts).squeeze(-1).mT


def pull_step(
    world_model: TaskWorldModel,
    actor: Layers,
    state: Tensor,
    noise: Tensor,
    adjoint: Tensor,
    limit: Tensor,
    bounds: ActionBounds,
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Carry the gradient of the returns back through one step of the worlds.

    A row whose action would change its return by more than ``limit`` for each half-range is scaled
    down to the limit, together with what goes further back. One that is not finite is left out.

    Args:
        world_model: the model.
        actor: layers of the actor.
        state: states before the step, ``[N, n]``.
        noise: noise of the step, ``[N, m]``.
        adjoint: :math:`\gamma \lambda_{t+1}`, 0 after a termination, ``[N, n]``.
        limit: largest norm of :math:`g_t` in units of reward for each half-range of the action.
        bounds: bounds of the action.

    Returns:
        :math:`\lambda_t` ``[N, n]``, :math:`g_t` ``[N, m]``, and which rows were limited or left
        out, bool ``[N]``.
    """
    action, pull_action = _with_pull(
        lambda s: noisy_action(actor, world_model.observe(s), noise, bounds), state
    )
    (_, reward), pull = _with_pull(
        lambda s, a: tuple(finite_transition(world_model.transition, s, a)[:2]), state, action
    )
    to_state, to_action = pull((adjoint, torch.ones_like(reward)))
    (through_action,) = pull_action(to_action)
    to_state = to_state + through_action
    size = (to_action * bounds.scale).norm(dim=-1)
    finite = size.isfinite() & to_state.isfinite().all(-1)
    factor = (limit / size.clamp_min(torch.finfo(size.dtype).tiny)).clamp_max(1.0)
    keep, factor = finite.unsqueeze(-1), factor.unsqueeze(-1)
    zero = torch.zeros((), dtype=size.dtype, device=size.device)
    return (
        torch.where(keep, factor * to_state, zero),
        torch.where(keep, factor * to_action, zero),
        ~finite | (size > limit),
    )


def _with_pull(function: Callable[..., Any], *inputs: Tensor) -> tuple[Any, Callable[..., Any]]:
    """The function's value, and the function that carries gradients back from it."""
    found = vjp(function, *inputs)
    return found[0], found[1]


def followed(
    actor: Layers,
    observation: Tensor,
    noise: Tensor,
    gradient: Tensor,
    bounds: ActionBounds,
    entropy: Tensor,
) -> Tensor:
    r"""The loss whose gradient is that of the returns and of the entropy, averaged over steps.

    .. math::
        -\sum_t g_t^\top \pi(s_t) - \alpha \log (1 - \tanh^2 u_t)

    The second term is the entropy of the noisy actor but for a constant, because the noise on its
    output :math:`u` has a given size (SAPO, arXiv:2412.12089, learns that size). It keeps the tanh
    away from its ends, where neither noise nor gradients get through.

    Args:
        actor: layers of the actor.
        observation: observations of all steps, ``[H * N, o]``.
        noise: their noise, ``[H * N, m]``.
        gradient: the returns' gradients by the actions, constants here, ``[H * N, m]``.
        bounds: bounds of the action.
        entropy: weight α of the entropy, in the units of the returns.
    """
    output = mlp(actor, observation) + noise
    # log(1 - tanh²) in a form that stays finite.
    spread = 2.0 * (math.log(2.0) - output - F.softplus(-2.0 * output))
    action = bounds.from_unit(output.tanh())
    return -(action * gradient + entropy * spread).sum(-1).mean()


def limited(gradients: Layers, most: float) -> tuple[list[Tensor], Tensor]:
    """Scale gradients down to a norm of ``most``, or to 0 if they are not finite.

    Returns:
        The gradients, and their norm before.
    """
    norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
    factor = (most / norm.clamp_min(torch.finfo(norm.dtype).tiny)).clamp_max(1.0)
    finite = norm.isfinite()
    return [torch.where(finite, factor * g, torch.zeros_like(g)) for g in gradients], norm
