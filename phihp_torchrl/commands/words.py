"""Commands whose settings are one small dataclass: command line, help and errors."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from phihp_torchrl.config import (
    ConfigError,
    file_error,
    from_mapping,
    override_key,
    parse_overrides,
    sentences_of,
)

T = TypeVar("T")


def read_words(cls: type[T], words: Sequence[str]) -> T:
    """Read settings from ``key=value`` words.

    ``world=NAME`` sets the kind of the world: ``world=gymnasium world.id=Pendulum-v1``.

    Raises:
        ConfigError: for a word that is no assignment, and a key or value that does not fit.
    """
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    settings: Any = OmegaConf.create({})
    for line in parse_overrides(words):
        key, value = override_key(line), line.value()
        if key == "world" and "world" in known and isinstance(value, str):
            key = f"{key}.kind"
        OmegaConf.update(settings, key, value, force_add=True)
    plain: Any = OmegaConf.to_container(settings)
    return from_mapping(cls, plain)


def read_lines(words: Sequence[str]) -> dict[str, Override]:
    """The assignments among words by their keys; plugins among them are imported.

    That comes first, for the other words may choose what they register.

    Raises:
        ConfigError: for a word that cannot be read, and a plugin that cannot be imported.
    """
    lines = {override_key(line): line for line in parse_overrides(words)}
    if "plugins" in lines:
        from phihp_torchrl.trainers import import_plugins

        plugins: Any = lines["plugins"].value()
        import_plugins([plugins] if isinstance(plugins, str) else plugins or ())
    return lines


def help_of(cls: type, usage: str) -> str:
    """Return the text of ``--help``: each setting with its default and a sentence."""
    words = sentences_of(cls)
    lines = [f"usage: {usage}", ""]
    for f in fields(cls):
        value = "..." if f.default is MISSING else f.default
        value = str(value).lower() if value is None or isinstance(value, bool) else value
        value = "null" if value == "none" else value
        lines.append(f"  {f'{f.name}={value}':<28} {words.get(f.name, '')}")
    return "\n".join(lines)


def run_command(cls: type[T], words: Sequence[str], usage: str, do: Callable[[T], None]) -> None:
    """Read the words and run the command; a wrong setting exits with a message of one line."""
    if any(word in ("-h", "--help") for word in words):
        print(help_of(cls, usage))  # noqa: T201 (a console command)
        return
    try:
        do(read_words(cls, words))
    except ConfigError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        sys.exit(f"error: {file_error(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
