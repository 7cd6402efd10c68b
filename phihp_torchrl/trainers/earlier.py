"""Whether a run may go on from another one: of the same task, with the same settings of it."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from typing import Any

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import describe_task
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory

_log = logging.getLogger(__name__)

TASK = "task"
"""The key of a run's metadata that describes the task which it was started with."""
_SETTINGS = ("actuator", "action_rate_limit", "action_rate_cost", "constraints")
"""What settings of a run change in its task."""
_PRICES = ("action_rate_cost", "constraints")
"""What the policy is the first to learn of; a model is the same at any."""


def describe(task: Task) -> dict[str, Any]:
    """What a run's metadata say of its task, as JSON reads it."""
    plain: dict[str, Any] = json.loads(json.dumps(describe_task(task)))
    return {**plain, "registers": task.register_count}


def check_earlier(config: RunConfig, task: Task) -> None:
    """Refuse to go on from a run of a task that differs, and warn where its world does.

    What it has learned is of states with its own commands under way, and of its own limits. A
    policy that is learned anew may have other prices and constraints. Runs of earlier versions do
    not describe their task, and their settings are compared.

    Args:
        config: settings of the run; one that begins with the first phase goes on from none.
        task: its task, as its world has it.

    Raises:
        ConfigError: naming what differs, with what the earlier run had as expected.
    """
    if config.start_from is None:
        return
    source = RunDirectory(config.start_from)
    settings = source.read_config()
    if settings.get("task") != config.task:
        return  # which is refused by name
    saved = _saved(source)
    if saved is None:
        theirs, ours = _of_settings(settings), _of_settings(config.to_mapping())
    else:
        theirs, ours = saved, describe(task)
    free = _PRICES if "policy" in config.phases_to_do else ()
    for key in dict.fromkeys((*_SETTINGS, *ours, *theirs)):
        if key not in free:
            _compare(key, theirs.get(key), ours.get(key), source)
    _compare_worlds(settings.get("world"), config, source)


def _saved(source: RunDirectory) -> dict[str, Any] | None:
    """The description of the task of a run; ``None`` where it has none that can be read."""
    try:
        saved = source.read_metadata().get(TASK)
    except ConfigError:
        return None
    return saved if isinstance(saved, dict) else None


def _of_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """What settings change in a task; none for what they leave as the task has it."""
    return {key: None if (value := settings.get(key)) == {} else value for key in _SETTINGS}


def _compare(key: str, theirs: Any, ours: Any, source: RunDirectory) -> None:
    """Refuse what differs, of a signature by the first part of it."""
    if theirs == ours:
        return
    parts = [{} if value is None else value for value in (theirs, ours)]
    if key not in _SETTINGS and all(isinstance(each, Mapping) for each in parts):
        for part in {**parts[0], **parts[1]}:
            _compare(f"{key}.{part}", parts[0].get(part), parts[1].get(part), source)
        return
    reason = (
        f"expected {_text(theirs)}, with which the run in {source.path} was started, "
        f"got {_text(ours)}."
    )
    if key in _SETTINGS:
        raise ConfigError(key, reason)
    raise ConfigError("from", f"the task is another one now. {key}: {reason}")


def _compare_worlds(theirs: Any, config: RunConfig, source: RunDirectory) -> None:
    kind = theirs.get("kind") if isinstance(theirs, Mapping) else theirs
    if kind not in (None, config.world.kind):
        _log.warning(
            "The run in %s is of world=%s, and this one goes on in world=%s: what it learns and "
            "how it is judged may be of another system.",
            source.path,
            kind,
            config.world.kind,
        )


def _text(value: Any) -> str:
    return "none" if value is None else json.dumps(value)
