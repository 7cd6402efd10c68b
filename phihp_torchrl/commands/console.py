"""The console command ``phihp``: which command is meant, and its words."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from phihp_torchrl.commands.letters import use_utf8
from phihp_torchrl.display import loading

COMMANDS = {
    "train": "learn a model, a policy and a planner: phihp train task=acrobot",
    "evaluate": "play a trained agent: phihp evaluate agent=results/agents/acrobot",
    "identify": "fit the constants of a task's system to recordings or steps, and report on them",
    "export": "write an agent's plan as one file: phihp export agent=DIR formats=[onnx]",
    "list": "print tasks, methods, presets, worlds and planners, a line each",
}
"""Commands and what each does, in a line. Each is a module here, with a function ``main``."""
_SILENT = {"-h", "--help", "-c", "--cfg", "-m", "--multirun", "progress=false"}
"""Words with which there is nothing to load, or nothing to be said of one run."""


def main(words: Sequence[str] | None = None, *, command: str | None = None, **options: Any) -> None:
    """Run the console command ``phihp``.

    Args:
        words: words of the command line. Defaults to those of the process.
        command: name of the command. Defaults to the first word.
        options: options of the function ``main`` of the command's module.

    Raises:
        SystemExit: for an unknown command, and for errors of the command.

    Examples:
        >>> main(["--help"])  # doctest: +ELLIPSIS
        usage: phihp COMMAND [setting=value ...] [--help]
        ...
    """
    if words is None:
        use_utf8()
    words = list(sys.argv[1:] if words is None else words)
    if command is None:
        if not words or words[0] in ("-h", "--help"):
            print(usage())  # noqa: T201 (a console command)
            return
        command, *words = words
    if command not in COMMANDS:
        known = list(COMMANDS)
        sys.exit(f"error: command: expected one of {known}, got {command!r}.\n\n{usage()}")
    first = f"phihp {command}: loading PyTorch and TorchRL, which takes some seconds."
    try:
        with loading(first, enabled=command == "train" and not _SILENT & set(words)):
            import_module(f"phihp_torchrl.commands.{command}").main(words, **options)
    except KeyboardInterrupt:
        sys.exit(130)


def usage() -> str:
    """Return the text of ``phihp --help``.

    Examples:
        >>> usage().splitlines()[0]
        'usage: phihp COMMAND [setting=value ...] [--help]'
    """
    lines = ["usage: phihp COMMAND [setting=value ...] [--help]", ""]
    lines += [f"  {name:<10} {about}" for name, about in COMMANDS.items()]
    return "\n".join(lines)
