"""Tasks by name."""

from __future__ import annotations

from phihp_torchrl.tasks.base import Task

_TASKS: dict[str, Task] = {}


def register_task(task: Task, *, replace: bool = False) -> Task:
    """Make ``task`` known by its name to :func:`get_task` and to every recipe; returns it.

    Args:
        task: the task.
        replace: whether a task of that name may be replaced.

    Raises:
        ValueError: if the name is taken and ``replace`` is false.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task, register_task
        >>> task = register_task(replace(get_task("pendulum"), name="moon-pendulum"))
        >>> get_task("moon-pendulum") is task
        True
    """
    if task.name in _TASKS and not replace:
        raise ValueError(
            f"task: {task.name!r} is registered already; pass replace=True to replace it."
        )
    _TASKS[task.name] = task
    return task


def get_task(name: str) -> Task:
    """Return the task of that name.

    Raises:
        ValueError: if no such task is registered; the message lists those that are.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> get_task("cartpole").time_step
        0.02
    """
    if name not in _TASKS:
        raise ValueError(f"task: expected one of {sorted(_TASKS)}, got {name!r}.")
    return _TASKS[name]


def list_tasks() -> list[str]:
    """Names of all registered tasks, sorted."""
    return sorted(_TASKS)
