"""The directory of a run that is started or resumed."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, differences, get_method
from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.resume_command import resume_command
from phihp_torchrl.trainers.run_config import FREE_KEYS, RunConfig, is_enabled
from phihp_torchrl.trainers.run_directory import RunDirectory, new_run_directory
from phihp_torchrl.trainers.run_request import read_run_config

_log = logging.getLogger(__name__)


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
        raise ConfigError(
            "run_dir", f"{path} holds a run already; go on with: {resume_command(path)}"
        )
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
    names = get_method(config.method).phases
    for name in names[: names.index(config.phases_to_do[0])]:
        optional = hasattr(config.section(name), "enabled")
        if optional and not _has_done(source, theirs, name):
            if is_enabled(config.section(name)):
                _log.warning(
                    "%s has no phase %r, so this run has none either; to have it, begin with it: "
                    "phases=%s.",
                    source.path,
                    name,
                    str([name, *config.phases_to_do]).replace("'", ""),
                )
            ours[name]["enabled"] = False
            continue
        load_state(source.phase(name), metadata={"task": config.task})
        ours[name] = theirs[name]
    return read_run_config(ours)


def _has_done(source: RunDirectory, settings: dict[str, Any], name: str) -> bool:
    """Whether a run of these settings has done an optional phase."""
    return bool(settings.get(name, {}).get("enabled")) and source.phase(name).exists()


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
