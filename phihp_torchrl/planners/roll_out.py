"""Rolling action sequences out in a model: one step after another, or as a loop of a graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch._higher_order_ops import while_loop

from phihp_torchrl.tasks import ActionBounds

if TYPE_CHECKING:
    from phihp_torchrl.planners.problem import TensorModel

LONG_PLAN = 10
"""Steps from which on the graph of a plan is a loop.

On a GPU each turn of a loop would wait for the device, so graphs are written out there."""


class RolledOut(NamedTuple):
    """What comes of action sequences.

    Args:
        state: the last states, ``[rows, n]``.
        actions: the sequences, with the actor's actions in them, ``[H, rows, m]``.
        total: the discounted sums of rewards less prices, ``[rows]``.
        over: whether the sequences have ended, bool ``[rows]``; ``None`` where none can.
        lost: whether their states have left the finite numbers before, bool ``[rows]``.
    """

    state: Any
    actions: Tensor
    total: Tensor
    over: Tensor | None
    lost: Tensor


class Prices(NamedTuple):
    """How the rewards of steps become the score of a sequence.

    Args:
        gamma: discount.
        change_cost: price of a change of the action.
        bounds: bounds of the action, in whose half-ranges changes are.
        last: the action before the first ones, ``[rows, m]``; NaN, or ``None``, for none.
    """

    gamma: float
    change_cost: float
    bounds: ActionBounds
    last: Tensor | None

    def of(self, action: Tensor, previous: Tensor) -> Tensor:
        """The price of going from one action to another, ``[..., m]`` -> ``[...]``.

        Args:
            action: actions.
            previous: the actions before them; NaN for none, which costs nothing.
        """
        change = (action - previous) / self.bounds.scale
        # Before the first action of an episode there is none, which NaN says.
        return self.change_cost * change.square().sum(-1).nan_to_num(0.0)

    def discounts(self, horizon: int) -> list[float]:
        """The discount of each step, each the product of those before."""
        found = [1.0]
        for _ in range(horizon - 1):
            found.append(found[-1] * self.gamma)
        return found


class Guide:
    """Puts the actor's actions in the place of those of the first sequences.

    Args:
        bounds: bounds of the action.
        actor: the actor, a function from observation to action.
        noise: noise ``[H, rows', m]`` on the actions of the first ``rows'`` sequences, or ``None``.
        completed: number of sequences after these whose last action is the actor's.
    """

    def __init__(
        self,
        bounds: ActionBounds,
        actor: Callable[[Any], Tensor],
        noise: Tensor | None,
        completed: int,
    ) -> None:
        self.bounds, self.actor = bounds, actor
        self.noise, self.completed = noise, completed

    def noise_of(self, k: int, actions: Tensor) -> Tensor | None:
        """The noise on the actor's actions in a step, ``None`` where the actor has none.

        Args:
            k: number of the step.
            actions: the sequences, ``[H, rows, m]``.
        """
        noise = None if self.noise is None else self.noise[k]
        if self.completed and k == len(actions) - 1:
            none = torch.zeros_like(actions[k, : self.completed])
            noise = none if noise is None else torch.cat([noise, none])
        return noise

    def __call__(
        self, model: TensorModel, state: Any, action: Tensor, noise: Tensor | None
    ) -> Tensor:
        """The actions ``[rows, m]`` with the actor's at the head, where there is noise for them."""
        if noise is None:
            return action
        guided = noise.shape[0]
        proposal = self.actor(model.observe(state[:guided])) + noise
        return torch.cat([self.bounds.clip(proposal), action[guided:]])


def step_by_step(
    state: Any, actions: Tensor, model: TensorModel, guide: Guide | None, prices: Prices
) -> RolledOut:
    """Roll out by one step after another, each with its reward.

    Args:
        state: first state of each sequence, ``[rows, n]``.
        actions: the sequences, ``[H, rows, m]``.
        model: the model.
        guide: puts the actor's actions in, or ``None``.
        prices: discount and price of changes.
    """
    taken = []
    previous = prices.last
    for k, action in enumerate(actions.unbind(0)):
        if guide is not None:
            action = guide(model, state, action, guide.noise_of(k, actions))
            taken.append(action)
        state, reward, terminated = model.transition(state, action)
        if prices.change_cost:
            if previous is not None:
                reward = reward - prices.of(action, previous)
            previous = action
        # States of a stock environment are tensordicts, whose rewards and values alone are judged.
        finite = state.isfinite().all(-1) if isinstance(state, Tensor) else reward.isfinite()
        if k == 0:
            total, over, lost, discount = reward, terminated, ~finite, 1.0
        else:
            lost = lost | ~(finite | over)
            discount *= prices.gamma
            total = torch.where(over, total, torch.add(total, reward, alpha=discount))
            over = over | terminated
    return RolledOut(state, torch.stack(taken) if taken else actions, total, over, lost)


def in_a_loop(
    state: Tensor, actions: Tensor, model: TensorModel, guide: Guide | None, prices: Prices
) -> RolledOut:
    """Roll out as one loop of a graph that is compiled, which holds the step once.

    A long plan then compiles in a fraction of the time that it takes written out
    (``benchmarks/speed/loaded_plans.py`` measures both).

    Args:
        state: as for :func:`step_by_step`.
        actions: as for :func:`step_by_step`.
        model: as for :func:`step_by_step`.
        guide: as for :func:`step_by_step`.
        prices: as for :func:`step_by_step`.
    """
    horizon, rows = actions.shape[:2]
    discounts = actions.new_tensor(prices.discounts(horizon))
    act = None if guide is None else _guided_step(guide, actions)
    previous = prices.last
    if previous is None:
        previous = torch.full_like(actions[0], torch.nan)

    def goes_on(k: Tensor, *_: Tensor) -> Tensor:
        return k < horizon

    def step(
        k: Tensor,
        state: Tensor,
        total: Tensor,
        over: Tensor,
        lost: Tensor,
        previous: Tensor,
        taken: Tensor,
    ) -> tuple[Tensor, ...]:
        place = k.unsqueeze(0)
        action = actions.index_select(0, place)[0]
        if act is not None:
            action = act(model, state, action, place)
        moved, reward, terminated = model.transition(state, action)
        # What a turn of a loop gives must be new and lie as what it was given.
        state = moved.to(state.dtype, copy=True, memory_format=torch.contiguous_format)
        if prices.change_cost:
            reward = reward - prices.of(action, previous)
        lost = lost | ~(state.isfinite().all(-1) | over)
        earned = (discounts.index_select(0, place) * reward).to(total.dtype)
        total = torch.where(over, total, total + earned)
        taken = taken.index_copy(0, place, action.unsqueeze(0))
        return k + 1, state, total, over | terminated, lost, action.clone(), taken

    none = torch.zeros(rows, dtype=torch.bool, device=actions.device)
    first = (
        torch.zeros((), dtype=torch.int64),
        state.contiguous(),
        actions.new_zeros(rows),
        none,
        none.clone(),
        previous.contiguous(),
        torch.zeros_like(actions),
    )
    _, state, total, over, lost, _, taken = while_loop(goes_on, step, first)
    return RolledOut(state, taken, total, over, lost)


def _guided_step(guide: Guide, actions: Tensor) -> Callable[..., Tensor]:
    """The guide as a function of a step's place, for sequences ``[H, rows, m]`` in a loop."""
    horizon, completed = len(actions), guide.completed
    none = torch.zeros_like(actions[:, :completed])
    noise = none if guide.noise is None else torch.cat([guide.noise, none], 1)
    first, last = noise.shape[1] - completed, noise.shape[1]

    def act(model: TensorModel, state: Tensor, action: Tensor, place: Tensor) -> Tensor:
        acted = guide(model, state, action, noise.index_select(0, place)[0])
        if not completed:
            return acted
        at_end = (place == horizon - 1).to(action.device)
        own = torch.where(at_end, acted[first:last], action[first:last])
        return torch.cat([acted[:first], own, acted[last:]])

    return act


def at_once(
    state: Tensor, actions: Tensor, model: Any, guide: Guide | None, prices: Prices
) -> RolledOut:
    """Roll out with the rewards and ends of all steps together, for a model that judges apart.

    Args:
        state: as for :func:`step_by_step`.
        actions: as for :func:`step_by_step`.
        model: a model with ``commands``, ``advance`` and ``judge_path``.
        guide: as for :func:`step_by_step`.
        prices: as for :func:`step_by_step`.
    """
    states, commands, taken = [state], [], []
    known = model.commands(actions) if guide is None else None
    for k, action in enumerate(actions.unbind(0)):
        if guide is not None:
            action = guide(model, state, action, guide.noise_of(k, actions))
            taken.append(action)
        command, state = model.advance(state, action, None if known is None else known[k])
        states.append(state)
        commands.append(command)
    actions = torch.stack(taken) if taken else actions
    path = torch.stack(states)
    reward, gone = model.judge_path(path, torch.cat(commands))
    if prices.change_cost:
        first = actions[0] if prices.last is None else prices.last
        reward = reward - prices.of(actions, torch.cat([first[None], actions[:-1]]))
    over, bad = None, ~path[1:].isfinite().all(-1)
    if gone is not None:
        over = gone[-1]
        bad = torch.cat([bad[:1], bad[1:] & ~gone[:-1]])
        reward = torch.cat([reward[:1], reward[1:].masked_fill(gone[:-1], 0.0)])
    total, *rewards = reward.unbind(0)
    for each, discount in zip(rewards, prices.discounts(len(reward))[1:], strict=True):
        total = torch.add(total, each, alpha=discount)
    return RolledOut(state, actions, total, over, bad.any(0))
