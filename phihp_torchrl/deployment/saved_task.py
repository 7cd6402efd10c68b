"""The task of a saved agent: what its file says of it, and whether ours is the same."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, from_mapping
from phihp_torchrl.deployment.formats import TaskSignature
from phihp_torchrl.deployment.reading import AgentError
from phihp_torchrl.tasks import Actuator, Constraint, Task, get_task

_log = logging.getLogger(__name__)

_RATES = ("action_rate_limit", "action_rate_cost")


def describe_task(task: Task) -> dict[str, Any]:
    """Return what an agent's file says of its task, as plain values."""
    return {
        "task": asdict(TaskSignature.of(task)),
        **_additions(task),
        **({"outside": outside} if (outside := _outside(task)) else {}),
    }


def read_signature(mapping: Mapping[str, Any]) -> TaskSignature:
    """Return the signature in a file; raises ConfigError for missing or unknown keys."""
    names = {field.name for field in fields(TaskSignature)}
    if set(mapping) != names:
        raise ConfigError("task", f"expected the keys {sorted(names)}, got {sorted(mapping)}.")
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in mapping.items()
    }
    return TaskSignature(**values)


def find_task(
    path: Path,
    signature: TaskSignature,
    wanted: str | Task | None,
    content: Mapping[str, Any],
    *,
    partial: bool = False,
) -> Task:
    """Return the task that an agent's file is of, with all that it was trained with.

    A task that is found by its name has the actuator, the rates and the constraints of the file,
    which a run may have set otherwise than its task does; a warning says where the task has others
    of its own. One that is given keeps its own, and gets those of the file where it has none.

    Args:
        path: the file, for messages.
        signature: the signature in it.
        wanted: the task that it must be for, or its name; ``None`` for the registered one.
        content: what the file says besides, under the keys of :func:`describe_task`.
        partial: whether a file without a key says nothing of it, and not that the task has none.

    Raises:
        AgentError: if there is no such task here, or it is another one; the message has what the
            agent was trained with as expected.
    """
    task = _resolve(path, signature, wanted)
    if partial:
        content = {**describe_task(task), **content}
    try:
        trained = _with_additions(task, content)
    except (ValueError, TypeError, AttributeError) as error:
        raise AgentError(f"{path}: {error}") from error
    for name in ("actuator", *_RATES, "constraints"):
        here, there = getattr(task, name), getattr(trained, name)
        if here in (None, (), there):
            continue
        if isinstance(wanted, Task):
            raise another_task(path, task, f"its {name} {there}", here)
        _log.warning(
            "%s: the agent was trained with the %s %s, which is used, and task %r has %s here; "
            "pass it as task to have it refused.",
            path,
            name,
            there,
            task.name,
            here,
        )
    if (saved := content.get("outside", {})) != (ours := _outside(task)):
        raise another_task(path, task, f"the reference, inputs and disturbance {saved}", ours)
    return task if trained == task else trained


def another_task(path: Path, task: Task, expected: str, got: object) -> AgentError:
    """The error of a task that differs from the one in a file, which is what was expected."""
    return AgentError(
        f"{path}: task {task.name!r} is another one here: expected {expected}, got {got}."
    )


def _resolve(path: Path, saved: TaskSignature, wanted: str | Task | None) -> Task:
    if not isinstance(saved.name, str):
        raise AgentError(f"{path}: task.name: expected a text, got {saved.name!r}.")
    name = wanted.name if isinstance(wanted, Task) else wanted
    if name is not None and name != saved.name:
        raise AgentError(
            f"{path}: expected an agent for task {name!r}, got one for {saved.name!r}."
        )
    try:
        task = wanted if isinstance(wanted, Task) else get_task(saved.name)
    except ConfigError as error:
        raise AgentError(
            f"{path}: {error} Register it first, which on a command line is "
            "plugins=[my_task.py], or pass it as task."
        ) from error
    for field in fields(TaskSignature):
        here, there = (getattr(s, field.name) for s in (TaskSignature.of(task), saved))
        if here != there:
            raise another_task(path, task, f"its {field.name} {there!r}", repr(here))
    return task


def _outside(task: Task) -> dict[str, Any]:
    """The reference, inputs and disturbance that an agent depends on, as plain values."""
    disturbance = task.disturbance
    return {
        **task.outside.config,
        **({} if disturbance is None else {"disturbance": disturbance.config}),
    }


def _additions(task: Task) -> dict[str, Any]:
    """What a task adds to the state of its system, as plain values; nothing where it adds none."""
    rates = {name: value for name in _RATES if (value := getattr(task, name)) is not None}
    limits = [constraint.config for constraint in task.constraints]
    actuator = {} if task.actuator is None else {"actuator": task.actuator.config}
    return actuator | rates | ({"constraints": limits} if limits else {})


def _with_additions(task: Task, content: Mapping[str, Any]) -> Task:
    """The task with the actuator, the rates and the constraints the agent was trained for."""
    numbers = content.get("actuator")
    actuator = None if numbers is None else from_mapping(Actuator, numbers, "actuator")
    rates: dict[str, Any] = {name: content.get(name) for name in _RATES}
    constraints = _constraints(task, content.get("constraints", []))
    return replace(task, actuator=actuator, constraints=constraints, **rates)


def _constraints(task: Task, saved: list[dict[str, Any]]) -> tuple[Constraint, ...]:
    """The constraints of an agent's file, with the task's functions, which are no part of it."""
    functions = {each.name: each.function for each in task.constraints if each.function}
    made = []
    for entry in saved:
        values = dict(entry)
        if values.pop("function", False):
            name = values.get("name", "")
            if name not in functions:
                raise ConfigError(
                    "constraints",
                    f"the agent was trained with [{name!r}], a function that is no part of its "
                    "file: expected it in the task; pass it as task.",
                )
            values["function"] = functions[name]
        made.append(Constraint(**values))
    return tuple(made)
