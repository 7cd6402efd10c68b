"""Words of a command line in Hydra's grammar: read, completed and written."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from phihp_torchrl.config.errors import ConfigError

# Settings that are mappings with names of a user's choice, or that change something by name.
_MAPPINGS = ("actuator", "constraints", r"world\.(?:actuator|friction|constants|noise|columns)")


def parse_overrides(overrides: Sequence[str]) -> list[Override]:
    """Parse the words of a command line as Hydra's overrides, leaving out deletions (``~key``).

    Raises:
        ConfigError: for a word that cannot be parsed.
    """
    try:
        lines = OverridesParser.create().parse_overrides([*map(_with_any_letters, overrides)])
    except HydraException as error:
        raise ConfigError("settings", " ".join(str(error).split())) from error
    return [line for line in lines if not line.is_delete()]


def open_mappings(words: Sequence[str]) -> list[str]:
    """Prefix overrides that add keys to a mapping with ``++``, and quote what Hydra cannot read.

    Examples:
        >>> open_mappings(["world.friction={joint:0.1}", "actuator.lag=0.1", "seed=0"])
        ['++world.friction={joint:0.1}', '++actuator.lag=0.1', 'seed=0']
        >>> open_mappings(["run_dir=größe"])
        ["run_dir='größe'"]
    """
    adds = re.compile(rf"[\w.]+=\s*\{{|({'|'.join(_MAPPINGS)})\.[\w.]+=")
    words = [_with_any_letters(word) for word in words]
    return [f"++{word}" if adds.match(word) else word for word in words]


def _with_any_letters(word: str) -> str:
    """Quote a plain value with letters that Hydra's grammar takes in quotes alone."""
    key, _, value = word.partition("=")
    if value.isascii() or any(sign in value for sign in "'\"[]{}(),\\$"):
        return word
    return f"{key}='{value}'"


def override_key(line: Override) -> str:
    """Return the dotted key that an override sets."""
    return str(line.key_or_group)


def override_lines(overrides: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Write overrides as words of a command line.

    Examples:
        >>> override_lines({"policy.updates": 10, "model.hidden_sizes": [8, 8], "run_dir": None})
        ['policy.updates=10', 'model.hidden_sizes=[8,8]', 'run_dir=null']
    """
    if isinstance(overrides, str):
        raise ConfigError("overrides", f"expected a list of texts or a mapping, got {overrides!r}.")
    if isinstance(overrides, Mapping):
        return [f"{key}={quoted(value)}" for key, value in overrides.items()]
    return [str(line) for line in overrides]


def quoted(value: Any) -> str:
    """Write a value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{','.join(quoted(item) for item in value)}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{quoted(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        # Without quotes if Hydra's grammar reads it as text too, and not as a number or boolean.
        plain = re.fullmatch(r"[A-Za-z_/][\w./:-]*", value, re.ASCII)
        if plain and value.lower() not in ("null", "true", "false", "inf", "nan"):
            return value
        # In Hydra's grammar a backslash stands for itself, unless a quote follows it.
        escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + m[2].replace("'", "\\'"), value)
        return f"'{escaped}'"
    return repr(value)
