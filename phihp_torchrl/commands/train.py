"""``phihp train``: all phases of a method on a task, in a world.

``--help`` and ``--cfg job`` answer without importing torch; the rest is in ``job.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from hydra.core.override_parser.types import Override

from phihp_torchrl.commands.words import read_lines
from phihp_torchrl.config import ConfigError, help_text, settings_text


def main(words: Sequence[str] | None = None, *, method: str = "phihp") -> None:
    """Train as the words say.

    Args:
        words: the command line; by default the process's own.
        method: what to train where the words do not name a method.
    """
    words = list(sys.argv[1:] if words is None else words)
    settings, config_dir = split_flags(words)
    if not any(word.startswith(("method=", "resume=")) for word in settings) and method != "phihp":
        settings.append(f"method={method}")
        words.append(f"method={method}")
    try:
        lines = read_lines(settings)
        task = task_of_world(lines)
        settings, words = [*settings, *task], [*words, *task]
        if any(word in ("-h", "--help") for word in words):
            print(help_text(settings, config_dir))  # noqa: T201 (a console command)
        elif any(word in ("-c", "--cfg") for word in words):
            print(settings_text(settings, config_dir))  # noqa: T201
        else:
            from phihp_torchrl.commands.job import launch

            launch(words, settings, config_dir)
    except ConfigError as error:
        sys.exit(f"error: {error}")


def split_flags(words: Sequence[str]) -> tuple[list[str], str | None]:
    """The settings among the words of a command line, and the directory of ``--config-dir``.

    Examples:
        >>> split_flags(["-m", "seed=0,1", "--config-dir", "my_config"])
        (['seed=0,1'], 'my_config')
    """
    settings, config_dir = [], None
    rest = iter(words)
    for word in rest:
        if word in ("--config-dir", "-cd"):
            config_dir = next(rest, None)
        elif word.startswith("--config-dir="):
            config_dir = word.split("=", 1)[1]
        elif word in ("-c", "--cfg", "--package", "-p", "--config-name", "-cn"):
            next(rest, None)
        elif not word.startswith("-"):
            settings.append(word)
    return settings, config_dir


def task_of_world(lines: Mapping[str, Override]) -> list[str]:
    """The task that a world speaks of, where none is named and the world knows one."""
    if {"task", "resume"} & set(lines) or "world" not in lines:
        return []
    from phihp_torchrl.worlds import WORLDS

    kind = lines["world"].value()
    config = WORLDS[kind].config if isinstance(kind, str) and kind in WORLDS else None
    task_of = getattr(config, "task_of", None)
    if task_of is None:
        return []
    start = "world."
    given = {k.removeprefix(start): v.value() for k, v in lines.items() if k.startswith(start)}
    task = task_of(given)
    return [] if task is None else [f"task={task}"]
