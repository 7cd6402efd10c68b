"""Episodes of a few steps, where their length is not what a test is about."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from phihp_torchrl.tasks import Task, registry

STEPS = 20


@cache
def _brief(task: Task) -> Task:
    return replace(task, max_steps=min(STEPS, task.max_steps))


def shorten(patch: pytest.MonkeyPatch) -> None:
    """Let the episodes of all registered tasks end after ``STEPS`` steps."""
    entries = registry._TASKS._entries
    patch.setattr(registry._TASKS, "_entries", {k: _brief(v) for k, v in entries.items()})
