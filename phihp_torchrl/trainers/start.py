"""The directory a run starts in, or goes on in."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.config import ConfigError, differences, from_mapping, to_mapping
from phihp_torchrl.trainers.run_config import FREE_KEYS, RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory, new_run_directory


def start_directory(config: RunConfig, path: str | Path | None) -> tuple[RunConfig, RunDirectory]:
    """Make the directory of a new run, with the phases done elsewhere copied into it.

    Args:
        config: what the run is to be.
        path: its directory, which must not hold a run; ``None`` for a new one.

    Returns:
        The configuration, with the settings of the copied phases, and the directory.
    """
    if config.phases_before:
        config = _adopt(config)
    if path is None:
        path = new_run_directory(config.task, config.label)
    directory = RunDirectory(path, config.keep_checkpoints)
    if directory.config.exists():
        raise ConfigError(f"run_dir: {path} holds a run already; go on with resume={path}.")
    if directory.path.exists() and (not directory.path.is_dir() or any(directory.path.iterdir())):
        raise ConfigError(f"run_dir: expected an empty or new directory, {path} is not.")
    directory.path.mkdir(parents=True, exist_ok=True)
    if config.start_from is not None:
        source = RunDirectory(config.start_from)
        for name in config.phases_before:
            shutil.copytree(source.phase(name), directory.phase(name))
    directory.write_config(to_mapping(config))
    return config, directory


def _adopt(config: RunConfig) -> RunConfig:
    """``config`` with the settings of the phases that another run has done."""
    source = RunDirectory(config.start_from or "")
    theirs = _read_config(source)
    if theirs["task"] != config.task:
        raise ConfigError(
            f"from: {source.path} is of task {theirs['task']!r}, not {config.task!r}."
        )
    ours = to_mapping(config)
    for name in config.phases_before:
        load_state(source.phase(name), metadata={"task": config.task})
        ours[name] = theirs[name]
    return from_mapping(RunConfig, ours)


def _read_config(directory: RunDirectory) -> dict[str, Any]:
    """A run's configuration; keys that came after it have the defaults, which change nothing."""
    return to_mapping(from_mapping(RunConfig, directory.read_config()))


def check_same(config: RunConfig, directory: RunDirectory) -> None:
    """Refuse to resume with a configuration that the run was not started with."""
    lines = differences(to_mapping(config), _read_config(directory))
    lines = [line for line in lines if line.split(":")[0].split(".")[0] not in FREE_KEYS]
    if lines:
        raise ConfigError(
            f"resume: the run in {directory.path} was started with another configuration: "
            + "; ".join(lines)
        )
