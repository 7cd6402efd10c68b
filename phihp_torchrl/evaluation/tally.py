"""What is counted of episodes while they are played at once."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)


class Tally:
    """Sums the rewards and steps of the episodes that have not ended, ``[n]``.

    Args:
        task: the task, with the constraints that are judged.
        count: number of episodes, ``n``.
        device: device of what is added.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> tally, rows = Tally(get_task("pendulum"), 2), torch.zeros(2)
        >>> ends = torch.tensor([True, False])
        >>> [tally.add(rows, rows + 1.0, ends, ends) for _ in range(3)]
        [False, False, False]
        >>> returns, lengths, *_ = tally.result()
        >>> returns.tolist(), lengths.tolist()
        ([1.0, 3.0], [1, 3])
    """

    def __init__(self, task: Task, count: int, device: torch.device | None = None) -> None:
        self.task = task
        self.scale = task.bounds.scale.to(device or "cpu")
        self.actions: list[Tensor] = []
        self.returns = torch.zeros(count, dtype=torch.float64, device=device)
        self.lengths = torch.zeros(count, dtype=torch.int64, device=device)
        self.terminated = torch.zeros(count, dtype=torch.bool, device=device)
        self.lost = torch.zeros(count, dtype=torch.bool, device=device)
        self.alive = torch.ones(count, dtype=torch.bool, device=device)
        self.violated = torch.zeros(count, len(task.constraints), dtype=torch.int64, device=device)
        self.largest = torch.zeros(count, len(task.constraints), device=device)

    def judge(self, state: Tensor, command: Tensor) -> None:
        """Judge a step before it is added, by its next state and its command."""
        found = self.task.limits.violations(state, command).reshape(self.largest.shape)
        found = torch.where(self.alive.unsqueeze(-1), found.to(self.largest.dtype), 0.0)
        self.violated += found > 0
        self.largest = torch.maximum(self.largest, found)

    def add(
        self,
        action: Tensor,
        reward: Tensor,
        terminated: Tensor,
        done: Tensor,
        finite: Tensor | None = None,
    ) -> bool:
        """Add a step; returns whether all episodes have ended.

        An episode with an action, or a state (``finite`` false), that is not finite earns NaN.
        """
        action = action.reshape(-1, self.task.action_dim)
        good = action.isfinite().all(-1)
        self.lost |= self.alive & ~(good if finite is None else good & finite.reshape(-1))
        command = self.task.clip_action(action)
        self.actions.append(command / self.scale.to(command.dtype))
        self.returns += torch.where(self.alive, reward.reshape(-1).to(torch.float64), 0.0)
        self.lengths += self.alive
        self.terminated |= self.alive & terminated.reshape(-1)
        self.alive &= ~done.reshape(-1)
        return not self.alive.any()

    def result(self) -> tuple[Tensor, ...]:
        """Returns, lengths, terminations, chatter ``[n]``, and violations ``[n, c]``, by episode.

        Violations are the steps of each constraint, and the largest.
        """
        if count := int(self.lost.sum()):
            _log.warning(
                "In %d of %d episodes the policy's action or the state left the finite numbers; "
                "their returns are NaN.",
                count,
                len(self.lost),
            )
        returns = torch.where(self.lost, math.nan, self.returns)
        own = returns, self.lengths, self.terminated, self._chatter()
        return *own, self.violated, self.largest

    def _chatter(self) -> Tensor:
        """Mean change of the action in the second half of each episode; 0 where there is none."""
        actions = torch.stack(self.actions).double()
        changes = actions.diff(dim=0).abs().mean(-1)  # row k is the change at step k + 1
        step = torch.arange(1, len(actions), device=changes.device).unsqueeze(-1)
        counts = (step >= self.lengths / 2) & (step < self.lengths)
        total = torch.where(counts, changes, 0.0).sum(0)
        return total / counts.sum(0).clamp_min(1)
