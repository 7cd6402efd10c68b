"""The task of a saved agent: what its file says of it, and whether ours is the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, from_mapping
from phihp_torchrl.deployment.formats import TaskSignature
from phihp_torchrl.deployment.reading import AgentError
from phihp_torchrl.tasks import Actuator, Constraint, Task, get_task

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
    path: Path, signature: TaskSignature, wanted: str | Task | None, content: Mapping[str, Any]
) -> Task:
    """Return the task that an agent's file is of, with all that it was trained with.

    Args:
        path: the file, for messages.
        signature: the signature in it.
        wanted: the task that it must be for, or its name; ``None`` for the registered one.
        content: the file's content.

    Raises:
        AgentError: if there is no such task here, or it is another one.
    """
    task = _with_additions(path, _resolve(path, signature, wanted), content)
    if (saved := content.get("outside", {})) != (ours := _outside(task)):
        raise AgentError(
            f"{path}: task {task.name!r} is another one here: expected the reference, inputs and "
            f"disturbance {saved}, got {ours}."
        )
    return task


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
    except ValueError as error:
        raise AgentError(f"{path}: {error} Register it first, or pass it as task.") from error
    for field in fields(TaskSignature):
        here, there = (getattr(s, field.name) for s in (TaskSignature.of(task), saved))
        if here != there:
            raise AgentError(
                f"{path}: task {saved.name!r} is another one here: expected its {field.name} "
                f"{here!r}, got {there!r}."
            )
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


def _with_additions(path: Path, task: Task, content: Mapping[str, Any]) -> Task:
    """The task with the actuator, the rates and the constraints the agent was trained for."""
    numbers = content.get("actuator")
    try:
        actuator = None if numbers is None else from_mapping(Actuator, numbers, "actuator")
        rates = {name: content.get(name) for name in _RATES}
        constraints = _constraints(task, content.get("constraints", []))
        changed = replace(task, actuator=actuator, constraints=constraints, **rates)  # type: ignore[arg-type]
    except (ConfigError, TypeError, AttributeError) as error:
        raise AgentError(f"{path}: {error}") from error
    for name in ("actuator", *_RATES):
        here, saved = getattr(task, name), getattr(changed, name)
        if here not in (None, saved):
            raise AgentError(
                f"{path}: task {task.name!r} is another one here: expected its {name} {here}, "
                f"got {saved}."
            )
    return task if changed == task else changed


def _constraints(task: Task, saved: list[dict[str, Any]]) -> tuple[Constraint, ...]:
    """The constraints of an agent's file: those of the task, or made anew where it has none."""
    ours = [constraint.config for constraint in task.constraints]
    if saved == ours:
        return task.constraints
    if ours:
        raise ConfigError(
            "constraints",
            f"task {task.name!r} is another one here: expected its constraints {ours}, "
            f"got {saved}.",
        )
    if functions := [entry["name"] for entry in saved if entry.get("function")]:
        raise ConfigError(
            "constraints",
            f"the agent was trained with {functions}, functions that are no part of its file: "
            "expected them in the task; pass it as task.",
        )
    return tuple(Constraint(**entry) for entry in saved)
