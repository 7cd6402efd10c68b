"""Receding horizon: acting on a plan for several steps, and starting the next plan from it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


class RecedingHorizon:
    """Takes several actions of one plan, and starts the next plan from the remaining actions.

    It keeps one plan for each row of a batch. The plan of a row is dropped when a new episode
    starts in it, and all plans are dropped when the shape of the batch changes.

    Args:
        replan_every: number of actions of a plan that are taken before the next plan.
        warm_start: whether the next plan starts from the previous one, shifted.
    """

    def __init__(self, replan_every: int, warm_start: bool) -> None:
        self.replan_every = replan_every
        self.warm_start = warm_start
        self.clear()

    def clear(self) -> None:
        """Drop all plans, and the last action."""
        self._plans: Tensor | None = None
        self._age: Tensor | None = None
        self._last: Tensor | None = None
        self._missed = 0

    def act(
        self,
        plan: Callable[[Tensor | None], Tensor],
        batch: torch.Size,
        is_init: Tensor | None,
        center: Tensor,
    ) -> Tensor:
        """Return the action of this step, ``[*batch, m]``, after planning in the rows that need it.

        Args:
            plan: makes a plan ``[*batch, H, m]`` around a mean of that shape, or without a mean.
            batch: the batch size.
            is_init: whether an episode starts, bool ``[*batch]``; ``None`` if unknown.
            center: mean of a first plan, which also fills up shifted plans, ``[H, m]``.
        """
        cold = center.expand(*batch, *center.shape)
        if self.replan_every == 1:  # every row plans at every step, so ages are not needed
            found = plan(self.recall(is_init, cold) if self.warm_start else None)
            self.remember(found)
            return found[..., 0, :]
        plans, age = self._plans, self._age
        if plans is None or age is None or not self._fits(cold):
            plans = plan(self.recall(is_init, cold) if self.warm_start else None)
            age = torch.zeros(batch, dtype=torch.long, device=plans.device)
        else:
            age = age + 1
            if is_init is not None:
                age = age.masked_fill(is_init, self.replan_every)
            due = age >= self.replan_every
            if due.any():
                mean = self.recall(is_init, cold, age) if self.warm_start else None
                plans = torch.where(due[..., None, None], plan(mean), plans)
                age = age.masked_fill(due, 0)
        self._plans, self._age = plans, age
        index = age[..., None, None].expand(*batch, 1, center.shape[-1])
        return plans.gather(-2, index).squeeze(-2)

    def recall(self, is_init: Tensor | None, cold: Tensor, age: Tensor | None = None) -> Tensor:
        """Return the last plan, shifted by the steps since, as the mean of the next one.

        Args:
            is_init: whether an episode starts, bool ``[*batch]``; ``None`` if unknown.
            cold: fills up the shifted plan, and replaces it at the start of an episode,
                ``[*batch, H, m]``.
            age: steps since the last plan of each row, ``[*batch]``, where they differ.
        """
        if self._plans is None or not self._fits(cold):
            return cold.contiguous()  # other strides would need another compiled graph
        horizon = cold.shape[-2]
        if age is None:
            steps = min(self.replan_every + self._missed, horizon)
            mean = torch.cat([self._plans[..., steps:, :], cold[..., :steps, :]], -2)
        else:
            places = age[..., None, None] + torch.arange(horizon, device=age.device)[:, None]
            later = self._plans.gather(-2, places.clamp_max(horizon - 1).expand_as(cold))
            mean = torch.where(places < horizon, later, cold)
        return mean if is_init is None else torch.where(is_init[..., None, None], cold, mean)

    def remember(self, plans: Tensor) -> None:
        """Keep ``plans`` ``[*batch, H, m]`` for :meth:`recall`."""
        self._plans, self._missed = plans, 0

    def last_action(self, is_init: Tensor | None, like: Tensor) -> Tensor:
        """Return the action that was taken last, NaN where an episode starts.

        Args:
            is_init: whether an episode starts, bool ``[*batch]``; ``None`` if unknown.
            like: a tensor of the shape, dtype and device of the actions, ``[*batch, m]``.
        """
        none = torch.full_like(like, torch.nan, memory_format=torch.contiguous_format)
        last = self._last
        if last is None or last.shape != none.shape or last.device != none.device:
            return none
        return last if is_init is None else torch.where(is_init[..., None], none, last)

    def record(self, action: Tensor) -> None:
        """Keep an action ``[*batch, m]`` for :meth:`last_action`."""
        self._last = action

    def follow(self, sent: Tensor, missed: int = 0) -> None:
        """Go on after steps in which others acted.

        Args:
            sent: the action that was taken last, ``[*batch, m]``.
            missed: steps, after the one in which it was planned last, by which plans move up.
        """
        self.record(sent)
        if self._age is not None:
            self._age = self._age + missed
        elif self._plans is not None:
            self._missed += missed

    def _fits(self, cold: Tensor) -> bool:
        plans = self._plans
        return plans is not None and plans.shape == cold.shape and plans.device == cold.device
