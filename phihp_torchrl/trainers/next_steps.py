"""What to do with a run, as commands that can be pasted."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from phihp_torchrl.config import override_lines
from phihp_torchrl.trainers.run_directory import RunDirectory


def program() -> list[str]:
    """The words that call the command line from here: ``phihp``, or the interpreter's module.

    Examples:
        >>> program()[-1] in ("phihp", "phihp_torchrl")
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
    """What one does next with a finished run, and the command for it.

    Args:
        path: directory of the run.

    Examples:
        >>> [what for what, _ in next_steps(Path("outputs/a run"))]
        ['go on to a later phase from it']
    """
    directory = RunDirectory(path)
    if not directory.agent.is_dir():
        return [("go on to a later phase from it", _command(["train"], {"from": str(path)}))]
    agent = {"agent": str(directory.agent)}
    return [
        ("play it in more episodes", _command(["evaluate"], {**agent, "episodes": 200})),
        ("write it as one file for another machine", _command(["export"], agent)),
    ]


def resume_command(path: str | Path) -> str:
    """The command that goes on with a run, quoted for Hydra and for a shell.

    Examples:
        >>> resume_command(Path("outputs/my-run")).split()[-2:]
        ['train', 'resume=outputs/my-run']
    """
    return _command(["train"], {"resume": str(path)})


def _command(words: list[str], settings: Mapping[str, object]) -> str:
    return shlex.join([*program(), *words, *override_lines(settings)])
