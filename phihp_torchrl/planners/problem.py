"""The score of an action sequence: rewards in the model, and Q beyond the horizon (equation 4)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from phihp_torchrl.planners.roll_out import (
    Guide,
    Prices,
    RolledOut,
    at_once,
    in_a_loop,
    step_by_step,
)
from phihp_torchrl.tasks import ActionBounds


class TensorModel(Protocol):
    """The interface of models for planners: pure functions with any leading batch dimensions.

    :class:`~phihp_torchrl.dynamics.TaskWorldModel` implements it. States and observations are
    tensors, or tensordicts where an environment is stepped.
    """

    def locate(self, observation: Any) -> Any:
        """Map an observation ``[*batch, o]`` to the state ``[*batch, n]``."""

    def observe(self, state: Any) -> Any:
        """Map a state ``[*batch, n]`` to its observation ``[*batch, o]``."""

    def transition(self, state: Any, action: Tensor) -> tuple[Any, Tensor, Tensor]:
        """Return next state ``[*batch, n]``, reward and (bool) terminated, each ``[*batch]``."""


@dataclass(frozen=True)
class Problem:
    """The functions that a plan is computed with: model, bounds, actor and value.

    Args:
        model: the model, with methods ``locate``, ``observe`` and ``transition`` as
            :class:`~phihp_torchrl.dynamics.TaskWorldModel` has them.
        bounds: bounds of the action.
        actor: a function from observation ``[rows, o]`` to action ``[rows, m]`` in physical units,
            or ``None``.
        value: a function from observation and action to min(Q1, Q2) ``[rows]``, or ``None``. Needs
            an actor.
        judge: a function from first states and actions ``[H, rows, m]`` to scores ``[rows]``, which
            takes the place of equation 4 where there are no candidates of an actor; or ``None``.
        in_loop: whether the steps of a sequence are one loop of a graph that is compiled, rather
            than written out one after the other.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("cartpole")
        >>> problem = Problem(TaskWorldModel(task, HybridDynamics.hybrid(task)), task.bounds)
        >>> state, actions = torch.zeros(3, 4), torch.zeros(5, 3, 1)
        >>> scores, _ = score_sequences(state, actions, problem, gamma=1.0, alpha=0.0)
        >>> scores  # CartPole rewards every step
        tensor([5., 5., 5.])
    """

    model: TensorModel
    bounds: ActionBounds
    actor: Callable[[Any], Tensor] | None = None
    value: Callable[[Any, Tensor], Tensor] | None = None
    judge: Callable[[Any, Tensor], Tensor] | None = None
    in_loop: bool = False


def score_sequences(
    state: Any,
    actions: Tensor,
    problem: Problem,
    *,
    gamma: float,
    alpha: float,
    policy_noise: Tensor | None = None,
    reduced_tail: bool = False,
    change_cost: float = 0.0,
    last: Tensor | None = None,
    completed: int = 0,
) -> tuple[Tensor, Tensor]:
    r"""Score action sequences by rolling them out in the model (paper, equation 4).

    .. math::
        \sum_{k<H} \gamma^k \big(r_k - c\,|a_k - a_{k-1}|^2\big)
        + \alpha \gamma^H \min(Q_1, Q_2)(s_H, \pi(s_H)),

    where terms after a termination are 0, and changes are in units of the action's half-range. A
    score that is not finite becomes -inf, and so does that of a sequence whose state leaves the
    finite numbers, whatever its rewards are.

    Args:
        state: first state of each sequence, ``[rows, n]``.
        actions: the sequences, ``[H, rows, m]``.
        problem: model, bounds, actor and value.
        gamma: discount.
        alpha: weight of the value term; 0 leaves it out.
        policy_noise: noise ``[H, rows', m]`` on the actor's actions, which replace the actions of
            the first ``rows'`` sequences; they are clipped with the noise.
        reduced_tail: whether to evaluate the value term in bfloat16.
        change_cost: price c of a change of the action, which is not in the paper.
        last: the action before the first ones, ``[rows, m]``; NaN, or ``None``, where there is
            none, so that the first action has no price.
        completed: number of sequences after the first ``rows'`` whose last action is the actor's.

    Returns:
        The scores ``[rows]``, and the sequences with the actor's actions in them,
        ``[H, rows, m]``.
    """
    model, actor = problem.model, problem.actor
    if problem.judge is not None:
        scores = problem.judge(state, actions)
        return torch.nan_to_num(scores, *(float("-inf"),) * 3), actions
    roll_out: Callable[..., RolledOut] = at_once if hasattr(model, "judge_path") else step_by_step
    guide = None
    if actor is not None and (policy_noise is not None or completed):
        guide = Guide(problem.bounds, actor, policy_noise, completed)
    if problem.in_loop:
        roll_out = in_a_loop
    prices = Prices(gamma, change_cost, problem.bounds, last)
    state, actions, total, over, lost = roll_out(state, actions, model, guide, prices)
    if alpha and problem.value is not None and actor is not None:
        discount = prices.discounts(len(actions) + 1)[-1]
        observation = model.observe(state)
        reduced = torch.autocast(total.device.type, torch.bfloat16)
        with reduced if reduced_tail else nullcontext():
            tail = problem.value(observation, actor(observation)).to(total.dtype)
        valued = torch.add(total, tail, alpha=alpha * discount)
        total = valued if over is None else torch.where(over, total, valued)
    if guide is not None:
        lost = lost | ~actions.isfinite().all(-1).all(0)
    total = total.masked_fill(lost, float("-inf"))
    return torch.nan_to_num(total, *(float("-inf"),) * 3), actions
