"""What a sequence of actions is worth: rewards in the model, and Q beyond the horizon."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor


class TensorModel(Protocol):
    """A model that planners roll out as pure functions, with any leading batch dims.

    :class:`~phihp_torchrl.dynamics.TaskWorldModel` is one. States and observations are tensors; an
    environment behind the same three methods has tensordicts in their place.
    """

    def locate(self, observation: Any) -> Any:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""

    def observe(self, state: Any) -> Any:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``."""

    def transition(self, state: Any, action: Tensor) -> tuple[Any, Tensor, Tensor]:
        """Next state ``[*batch, n]``, reward ``[*batch]`` and terminated, bool ``[*batch]``."""


@dataclass(frozen=True)
class ActionBounds:
    """Where actions may be, ``[m]`` each, and the unit in which their noise is measured.

    Args:
        low: lower bounds.
        high: upper bounds.
        center: the middle; zero where there is no bound.
        scale: the half-range; one where there is no bound.
    """

    low: Tensor
    high: Tensor
    center: Tensor
    scale: Tensor

    @classmethod
    def from_limits(cls, low: Tensor, high: Tensor) -> ActionBounds:
        """Bounds with their middle and half-range; limits may be infinite."""
        half = high / 2 - low / 2
        bounded = half.isfinite()
        center = torch.where(bounded, low / 2 + high / 2, torch.zeros_like(half))
        return cls(low, high, center, torch.where(bounded, half, torch.ones_like(half)))

    def clip(self, action: Tensor) -> Tensor:
        """Clip an action ``[*batch, m]``."""
        return action.clamp(self.low, self.high)


@dataclass(frozen=True)
class Problem:
    """What a plan is made for.

    Args:
        model: the model.
        bounds: the action's bounds.
        actor: observation ``[rows, o]`` -> action ``[rows, m]`` in physical units, or ``None``.
        value: observation, action -> min(Q1, Q2) ``[rows]``, or ``None``. Needs an actor.
    """

    model: TensorModel
    bounds: ActionBounds
    actor: Callable[[Any], Tensor] | None = None
    value: Callable[[Any, Tensor], Tensor] | None = None


def score_sequences(
    state: Any,
    actions: Tensor,
    problem: Problem,
    *,
    gamma: float,
    alpha: float,
    policy_noise: Tensor | None = None,
    reduced_tail: bool = False,
) -> tuple[Tensor, Tensor]:
    r"""Score sequences by rolling them out in the model (paper, equation 4).

    .. math::
        \sum_{k<H} \gamma^k r_k + \alpha \gamma^H \min(Q_1, Q_2)(s_H, \pi(s_H)),

    where nothing counts after a termination. A score that is not finite becomes -inf.

    Args:
        state: where each sequence starts, ``[rows, n]``.
        actions: the sequences, ``[H, rows, m]``.
        problem: model, actor and value.
        gamma: discount.
        alpha: weight of the value term; 0 leaves it out.
        policy_noise: makes the first ``rows'`` sequences the actor's: what is added to its actions,
            ``[H, rows', m]``, before they are clipped.
        reduced_tail: evaluates the value term under autocast to bfloat16.

    Returns:
        The scores ``[rows]`` and the sequences taken ``[H, rows, m]``.
    """
    model, actor = problem.model, problem.actor
    taken = []
    discount = 1.0
    for k, action in enumerate(actions.unbind(0)):
        if policy_noise is not None and actor is not None:
            guided = policy_noise.shape[1]
            proposal = actor(model.observe(state[:guided])) + policy_noise[k]
            action = torch.cat([problem.bounds.clip(proposal), action[guided:]])
            taken.append(action)
        state, reward, terminated = model.transition(state, action)
        if k == 0:
            total, over = reward, terminated
        else:
            total = torch.where(over, total, torch.add(total, reward, alpha=discount))
            over = over | terminated
        discount *= gamma
    if alpha and problem.value is not None and actor is not None:
        observation = model.observe(state)
        reduced = torch.autocast(total.device.type, torch.bfloat16)
        with reduced if reduced_tail else nullcontext():
            tail = problem.value(observation, actor(observation)).to(total.dtype)
        total = torch.where(over, total, torch.add(total, tail, alpha=alpha * discount))
    if taken:
        actions = torch.stack(taken)
        total = torch.where(actions.isfinite().all(-1).all(0), total, float("-inf"))
    return torch.nan_to_num(total, *(float("-inf"),) * 3), actions
