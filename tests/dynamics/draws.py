"""States and actions to try a model on."""

from __future__ import annotations

import torch


def draw(task, count=16):
    """Anywhere in the task's coverage, under any action in bounds."""
    state = (task.coverage or task.reset).sample([count])
    return state, task.bounds.from_unit(2 * torch.rand(count, task.action_dim) - 1)
