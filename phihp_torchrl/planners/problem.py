"""The score of an action sequence: rewards in the model, and Q beyond the horizon (equation 4)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

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
    guide = None
    if actor is not None and (policy_noise is not None or completed):
        guide = _Guide(problem, policy_noise, completed, len(actions))
    roll_out = _at_once if hasattr(model, "judge") else _step_by_step
    rolled = roll_out(state, actions, problem, guide, gamma, change_cost, last)
    state, actions, total, over, lost = rolled
    if alpha and problem.value is not None and actor is not None:
        discount = 1.0
        for _ in range(len(actions)):  # as the rewards' discounts, which are products
            discount *= gamma
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


class _Guide:
    """Puts the actor's actions in the place of those of the first sequences."""

    def __init__(
        self, problem: Problem, noise: Tensor | None, completed: int, horizon: int
    ) -> None:
        self.problem, self.noise, self.completed, self.last = problem, noise, completed, horizon - 1

    def __call__(self, k: int, state: Any, action: Tensor) -> Tensor:
        noise = None if self.noise is None else self.noise[k]
        if self.completed and k == self.last:
            none = torch.zeros_like(action[: self.completed])
            noise = none if noise is None else torch.cat([noise, none])
        if noise is None:
            return action
        problem, guided = self.problem, noise.shape[0]
        assert problem.actor is not None
        proposal = problem.actor(problem.model.observe(state[:guided])) + noise
        return torch.cat([problem.bounds.clip(proposal), action[guided:]])


def _step_by_step(
    state: Any,
    actions: Tensor,
    problem: Problem,
    guide: _Guide | None,
    gamma: float,
    change_cost: float,
    last: Tensor | None,
) -> tuple[Any, Tensor, Tensor, Tensor, Tensor]:
    """Last states, actions, sums of rewards, and which sequences end and which leave the finite.

    Takes one step after another.
    """
    taken = []
    discount, previous = 1.0, last
    for k, action in enumerate(actions.unbind(0)):
        if guide is not None:
            action = guide(k, state, action)
            taken.append(action)
        state, reward, terminated = problem.model.transition(state, action)
        if change_cost:
            if previous is not None:
                reward = reward - _price(action, previous, problem, change_cost)
            previous = action
        # States of a stock environment are tensordicts, whose rewards and values alone are judged.
        finite = state.isfinite().all(-1) if isinstance(state, Tensor) else reward.isfinite()
        if k == 0:
            total, over, lost = reward, terminated, ~finite
        else:
            lost = lost | ~(finite | over)
            total = torch.where(over, total, torch.add(total, reward, alpha=discount))
            over = over | terminated
        discount *= gamma
    return state, torch.stack(taken) if taken else actions, total, over, lost


def _at_once(
    state: Tensor,
    actions: Tensor,
    problem: Problem,
    guide: _Guide | None,
    gamma: float,
    change_cost: float,
    last: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor]:
    """The same, with rewards and ends of all steps together, for a model that judges apart."""
    model: Any = problem.model
    states, commands, taken = [state], [], []
    known = model.commands(actions) if guide is None else None
    for k, action in enumerate(actions.unbind(0)):
        if guide is not None:
            action = guide(k, state, action)
            taken.append(action)
        command, state = model.advance(state, action, None if known is None else known[k])
        states.append(state)
        commands.append(command)
    actions = torch.stack(taken) if taken else actions
    path, shape = torch.stack(states), actions.shape[:2]
    before, after = path[:-1].flatten(0, 1), path[1:].flatten(0, 1)
    reward, ended = model.judge(before, torch.cat(commands), after)
    reward = reward.view(shape)
    if change_cost:
        earlier = torch.cat([(actions[0] if last is None else last)[None], actions[:-1]])
        reward = reward - _price(actions, earlier, problem, change_cost)
    over, bad = None, ~path[1:].isfinite().all(-1)
    if ended is not None:
        gone = ended.view(shape).cumsum(0) > 0
        over = gone[-1]
        bad = torch.cat([bad[:1], bad[1:] & ~gone[:-1]])
        reward = torch.cat([reward[:1], reward[1:].masked_fill(gone[:-1], 0.0)])
    discount, (total, *rewards) = 1.0, reward.unbind(0)
    for each in rewards:
        discount *= gamma
        total = torch.add(total, each, alpha=discount)
    return state, actions, total, over, bad.any(0)


def _price(action: Tensor, previous: Tensor, problem: Problem, change_cost: float) -> Tensor:
    change = (action - previous) / problem.bounds.scale
    # Before the first action of an episode there is none, which NaN says.
    return change_cost * change.square().sum(-1).nan_to_num(0.0)
