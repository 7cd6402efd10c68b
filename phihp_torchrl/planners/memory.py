"""What a planner remembers between steps: its plan, for warm starts and receding horizons."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


class PlanMemory:
    """Act several steps of one plan, and start the next from where it left off.

    It remembers one plan for each row of a batch. Rows whose episode starts anew forget theirs; all
    do when the batch changes its shape.

    Args:
        replan_every: steps of a plan to act before the next.
        warm_start: whether the next plan starts from the previous one, shifted.
    """

    def __init__(self, replan_every: int, warm_start: bool) -> None:
        self.replan_every = replan_every
        self.warm_start = warm_start
        self.clear()

    def clear(self) -> None:
        """Forget all plans."""
        self._plans: Tensor | None = None
        self._age: Tensor | None = None

    def act(
        self,
        plan: Callable[[Tensor | None], Tensor],
        batch: torch.Size,
        is_init: Tensor | None,
        center: Tensor,
    ) -> Tensor:
        """The action of this step, ``[*batch, m]``.

        Args:
            plan: makes a plan ``[*batch, H, m]`` around a mean of that shape, or around nothing.
            batch: the batch size.
            is_init: where an episode starts, bool ``[*batch]``, if known.
            center: what comes before the first plan and after the end of the others, ``[H, m]``.
        """
        cold = center.expand(*batch, *center.shape)
        if self.replan_every == 1:  # all rows are due, always: no ages to keep, which take time
            self._plans = plan(self.recall(is_init, cold) if self.warm_start else None)
            return self._plans[..., 0, :]
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
                mean = self.recall(is_init, cold) if self.warm_start else None
                plans = torch.where(due[..., None, None], plan(mean), plans)
                age = age.masked_fill(due, 0)
        self._plans, self._age = plans, age
        index = age[..., None, None].expand(*batch, 1, center.shape[-1])
        return plans.gather(-2, index).squeeze(-2)

    def recall(self, is_init: Tensor | None, cold: Tensor) -> Tensor:
        """The last plan shifted by ``replan_every``, to start the next from, ``[*batch, H, m]``.

        Args:
            is_init: where an episode starts, bool ``[*batch]``, if known.
            cold: what comes after its end, and in its place where there is none.
        """
        if self._plans is None or not self._fits(cold):
            return cold.contiguous()  # like all that follow: other strides are another graph
        rest = self._plans[..., self.replan_every :, :]
        mean = torch.cat([rest, cold[..., : self.replan_every, :]], -2)
        return mean if is_init is None else torch.where(is_init[..., None, None], cold, mean)

    def remember(self, plans: Tensor) -> None:
        """Keep ``plans`` ``[*batch, H, m]`` for :meth:`recall`, at once."""
        self._plans = plans

    def _fits(self, cold: Tensor) -> bool:
        plans = self._plans
        return plans is not None and plans.shape == cold.shape and plans.device == cold.device
