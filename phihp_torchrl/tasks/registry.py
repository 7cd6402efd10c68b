"""The registered tasks, by name."""

from __future__ import annotations

from phihp_torchrl.config import Registry, offer
from phihp_torchrl.tasks.base import Task

_TASKS: Registry[Task] = Registry("task")


def register_task(task: Task, *, replace: bool = False) -> Task:
    """Register ``task`` under its name, so that settings can say ``task=name``; returns it.

    Args:
        task: the task.
        replace: whether a task of that name may be replaced.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task, register_task
        >>> task = replace(get_task("pendulum"), name="strong-pendulum", action_high=(4.0,),
        ...                action_low=(-4.0,))
        >>> register_task(task, replace=True) is get_task("strong-pendulum")
        True
    """
    _TASKS.register(task.name, task, replace=replace)
    # A task needs a YAML file only to change settings; without one it has those of the preset.
    offer("task", task.name, {"task": task.name})
    return task


def get_task(name: str) -> Task:
    """Return the registered task of that name.

    Raises:
        ConfigError: if no task of that name is registered; the message lists the registered names.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> get_task("cartpole").time_step
        0.02
    """
    return _TASKS.find(name)


def find_task(task: str | Task) -> Task:
    """Return ``task`` itself, or the registered task of that name."""
    return task if isinstance(task, Task) else get_task(task)


def list_tasks() -> list[str]:
    """List the names of all registered tasks, sorted.

    Examples:
        >>> "acrobot" in list_tasks()
        True
    """
    return sorted(_TASKS)
