"""What to do with a run, as commands that can be pasted."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, get_method, override_lines
from phihp_torchrl.trainers.changed_settings import settings_of
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.worlds import GivenConfig, has_env


def program() -> list[str]:
    """The words that call the command line from here: ``phihp``, or the interpreter's module.

    Examples:
        >>> Path(program()[-1]).name in ("phihp", "phihp_torchrl")
        True
    """
    if shutil.which("phihp") is not None:
        return ["phihp"]
    beside = Path(sys.executable).with_name("phihp")
    if beside.is_file():
        near = os.path.relpath(beside)
        return [str(beside) if near.startswith("..") else near]
    return [sys.executable, "-m", "phihp_torchrl"]


def next_steps(path: Path) -> list[tuple[str, str]]:
    """What one does next with a finished run, and the command for it, with the run's plugins.

    Args:
        path: directory of the run.

    Examples:
        >>> next_steps(Path("outputs/not-a-run"))
        []
    """
    directory = RunDirectory(path)
    if not directory.agent.is_dir():
        return _later_phases(directory)
    config = directory.read_config() if directory.config.is_file() else {}
    agent = {"agent": str(directory.agent), **_plugins(config)}
    steps = []
    if _is_played(config.get("world", "simulated")):
        play = _command(["evaluate"], {**agent, "episodes": 200})
        steps.append(("play it in more episodes", play))
    return [*steps, ("write it as one file for another machine", _command(["export"], agent))]


def _is_played(world: Any) -> bool:
    """Whether a command can play in the world of these settings; a Python object is not there."""
    return _kind(world) != GivenConfig.kind and has_env(world)


def _later_phases(directory: RunDirectory) -> list[tuple[str, str]]:
    """The command for the phases that a run of the first ones has left."""
    if not directory.config.is_file():
        return []
    config = directory.read_config()
    names = get_method(config.get("method", "phihp")).phases
    left = [
        name
        for name in names
        if not directory.phase(name).exists() and (config.get(name) or {}).get("enabled", True)
    ]
    if not left or len(left) == len(names):
        return []
    if _kind(config.get("world")) == GivenConfig.kind:
        return []  # no command has the world
    place = _config_dir(directory)
    settings = {"task": config["task"], "method": config.get("method", "phihp")}
    settings |= {"phases": left, "from": str(directory.path), **_plugins(config)}
    settings |= settings_of(config, place)
    words = ["train", *([] if place is None else ["--config-dir", place])]
    return [("go on to the phases that are left", _command(words, settings))]


def _kind(world: Any) -> Any:
    return world.get("kind") if isinstance(world, Mapping) else world


def _config_dir(directory: RunDirectory) -> str | None:
    """The directory of ``--config-dir`` that a run was started with, as far as it is recorded."""
    try:
        sessions = directory.read_metadata().get("sessions") or [{}]
    except ConfigError:
        return None
    words = iter(sessions[0].get("command") or ())
    for word in words:
        name, _, value = word.partition("=")
        if name in ("--config-dir", "-cd"):
            place = value or next(words, "")
            return place if place and Path(place).is_dir() else None
    return None


def _plugins(config: Mapping[str, Any]) -> dict[str, Any]:
    """The setting that imports what a run has imported; none where that is nothing."""
    return {"plugins": plugins} if (plugins := config.get("plugins")) else {}


def resume_command(path: str | Path) -> str:
    """The command that goes on with a run, quoted for Hydra and for a shell.

    Examples:
        >>> resume_command(Path("outputs/my-run")).split()[-2:]
        ['train', 'resume=outputs/my-run']
    """
    return _command(["train"], {"resume": str(path)})


def _command(words: list[str], settings: Mapping[str, object]) -> str:
    return shlex.join([*program(), *words, *override_lines(settings)])
