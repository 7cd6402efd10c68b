"""The directory of a run that is started or resumed."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, differences, digest_of_values, get_method
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.earlier import TASK, describe
from phihp_torchrl.trainers.files import STAGE, check_contained, remove_stages
from phihp_torchrl.trainers.lock import LOCK, OWNER, RunLock
from phihp_torchrl.trainers.next_steps import resume_command
from phihp_torchrl.trainers.run_config import FREE_KEYS, RunConfig, is_enabled
from phihp_torchrl.trainers.run_directory import RunDirectory, new_run_directory
from phihp_torchrl.trainers.run_request import read_run_config
from phihp_torchrl.trainers.stored import read_stored
from phihp_torchrl.trainers.trust import CONTROLLER, controller_of, sign

_log = logging.getLogger(__name__)


def new_directory(config: RunConfig, path: str | Path | None) -> tuple[RunConfig, RunDirectory]:
    """Make the directory of a new run.

    Args:
        config: settings of the run.
        path: its directory, which must be absent or empty; ``None`` for a new one.

    Returns:
        The configuration, with the settings of the phases that another run has done, and the
        directory.
    """
    if config.phases_before:
        config = _adopt(config)
    if path is None:
        path = new_run_directory(config.task, config.label)
    directory = RunDirectory(path, config.keep_checkpoints)
    if directory.config.exists():
        RunLock(directory.path).check()  # by whom it is taken says more than that it is
    _check_free(directory)
    try:
        directory.path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("run_dir", f"{path} cannot be made: {error}") from error
    return config, directory


def begin(config: RunConfig, directory: RunDirectory, task: Task) -> None:
    """Write the first files of a new run, and copy the phases that another run has done.

    ``config.yaml`` comes last: a directory without it holds nothing that would be lost.

    Args:
        config: settings of the run.
        directory: its directory.
        task: its task, which the metadata describe.
    """
    _check_free(directory)
    remove_stages(directory.path)
    settings = config.to_mapping()
    code = sign(settings)
    signed = {} if code is None else {"code": code}
    directory.write_metadata({"config": settings, TASK: describe(task), **signed})
    if config.start_from is not None:
        shutil.rmtree(directory.path / "phases", ignore_errors=True)
        source = RunDirectory(config.start_from)
        for name in config.phases_before:
            check_contained(source.phase(name))
            shutil.copytree(source.phase(name), directory.phase(name))
    directory.write_config(settings)


def _check_free(directory: RunDirectory) -> None:
    """Refuse a directory with anything else in it than a start that was cut off has left."""
    path = directory.path
    if directory.config.exists():
        raise ConfigError(
            "run_dir", f"{path} holds a run already; go on with: {resume_command(path)}"
        )
    if not path.exists():
        return
    ours = {LOCK, OWNER, directory.metadata.name}
    if directory.metadata.exists():
        ours.add("phases")  # copied after it
    if not path.is_dir() or any(
        entry.name not in ours and not entry.name.endswith(STAGE) for entry in path.iterdir()
    ):
        raise ConfigError("run_dir", f"expected an empty or new directory, {path} is not.")


def _adopt(config: RunConfig) -> RunConfig:
    """Take over the settings of the phases that another run has done."""
    source = RunDirectory(config.start_from or "")
    named = source.read_config().get("plugins") or ()
    if missing := [name for name in named if name not in config.plugins]:
        raise ConfigError(
            "plugins",
            f"the run in {source.path} has {missing}, and nothing that a folder names is imported "
            "unasked; expected them here too.",
        )
    theirs = _read_config(source)
    controller = controller_of(theirs)
    if controller is not None and controller != controller_of(config.to_mapping()):
        raise ConfigError(
            CONTROLLER,
            f"the run in {source.path} has {controller!r}, and nothing that a folder names is "
            "imported unasked; expected it here too.",
        )
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
    return read_run_config(directory.read_config(), imports=False).to_mapping()


def check_same(config: RunConfig, directory: RunDirectory) -> None:
    """Refuse to resume a run with other settings, or settings that were edited since its start."""
    found = _changes(config.to_mapping(), _read_config(directory))
    if found:
        raise ConfigError(
            "resume",
            f"the run in {directory.path} was started with another configuration: {found}",
        )


def open_metadata(directory: RunDirectory) -> dict[str, Any]:
    """The metadata of a run to resume, whose settings must be those it was started with.

    Damaged metadata are set aside with a warning, for no result depends on them; the settings are
    then held to those of the checkpoint.

    Raises:
        ConfigError: for a ``config.yaml`` that was edited; the message names the settings.
    """
    try:
        metadata = directory.read_metadata()
    except ConfigError as error:
        aside = directory.metadata.with_name(f"damaged-{directory.metadata.name}")
        _log.warning("%s They are set aside as %s.", error, aside.name)
        os.replace(directory.metadata, aside)
        metadata = {}
    if not metadata and directory.is_begun:
        _log.warning(
            "%s: the record of earlier sessions is lost: commands, commits, machines.",
            directory.metadata,
        )
    if (started := metadata.get("config")) is not None:
        found = _changes(read_stored(directory.config), started)
        if found:
            raise ConfigError(
                str(directory.config),
                f"was changed since the run was started: {found}. Set them back to resume the run; "
                "for other settings start another one, which may take over phases with "
                f"from={directory.path}.",
            )
    return metadata


def settings_digest(directory: RunDirectory) -> str:
    """The digest of the settings that a resumed run may not change, as its file has them."""
    settings = read_stored(directory.config)
    return digest_of_values({k: v for k, v in settings.items() if k not in FREE_KEYS})


def _changes(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    """The settings that differ, but for those that may, as text."""
    found = differences(ours, theirs)
    return "; ".join(
        f"{key}: {a!r}, not {b!r}" for key, a, b in found if key.split(".")[0] not in FREE_KEYS
    )
