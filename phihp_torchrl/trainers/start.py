"""The directory of a run that is started or resumed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, differences
from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.run_config import FREE_KEYS, RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory, new_run_directory
from phihp_torchrl.trainers.run_request import read_run_config


def start_directory(config: RunConfig, path: str | Path | None) -> tuple[RunConfig, RunDirectory]:
    """Make the directory of a new run, and copy the phases that another run has done.

    Args:
        config: settings of the run.
        path: its directory, which must be absent or empty; ``None`` for a new one.

    Returns:
        The configuration, with the settings of the copied phases, and the directory.
    """
    if config.phases_before:
        config = _adopt(config)
    if path is None:
        path = new_run_directory(config.task, config.label)
    directory = RunDirectory(path, config.keep_checkpoints)
    if directory.config.exists():
        raise ConfigError("run_dir", f"{path} holds a run already; go on with resume={path}.")
    if directory.path.exists() and (not directory.path.is_dir() or any(directory.path.iterdir())):
        raise ConfigError("run_dir", f"expected an empty or new directory, {path} is not.")
    directory.path.mkdir(parents=True, exist_ok=True)
    if config.start_from is not None:
        source = RunDirectory(config.start_from)
        for name in config.phases_before:
            shutil.copytree(source.phase(name), directory.phase(name))
    directory.write_config(config.to_mapping())
    return config, directory


def _adopt(config: RunConfig) -> RunConfig:
    """Take over the settings of the phases that another run has done."""
    source = RunDirectory(config.start_from or "")
    theirs = _read_config(source)
    if theirs["task"] != config.task:
        raise ConfigError(
            "from", f"{source.path} is of task {theirs['task']!r}, not {config.task!r}."
        )
    ours = config.to_mapping()
    for name in config.phases_before:
        load_state(source.phase(name), metadata={"task": config.task})
        ours[name] = theirs[name]
    return read_run_config(ours)


def _read_config(directory: RunDirectory) -> dict[str, Any]:
    """Read the configuration of a run; keys that it does not have get their defaults."""
    return read_run_config(directory.read_config()).to_mapping()


def check_same(config: RunConfig, directory: RunDirectory) -> None:
    """Refuse to resume a run with another configuration than it was started with."""
    found = differences(config.to_mapping(), _read_config(directory))
    found = [line for line in found if line[0].split(".")[0] not in FREE_KEYS]
    if found:
        lines = "; ".join(f"{key}: {ours!r}, not {theirs!r}" for key, ours, theirs in found)
        raise ConfigError(
            "resume",
            f"the run in {directory.path} was started with another configuration: {lines}",
        )
