"""Reading the settings that a run has stored: plain values, and nothing that is evaluated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers.yaml_file import parse_yaml

_MAX_BYTES, _MAX_DEPTH = 1_000_000, 40


def read_stored(path: Path) -> dict[str, Any]:
    """Read a stored ``config.yaml``, which may be damaged or hostile.

    Tags, which name Python objects, and references of YAML, which make a small file large, are
    refused; so are interpolations, which read environment variables and call resolvers.

    Raises:
        ConfigError: naming the file and, for an interpolation, its key.
    """
    try:
        with path.open("rb") as file:  # once: what is checked is what is read
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise ConfigError(str(path), f"expected at most {_MAX_BYTES} bytes of settings.")
        text = data.decode("utf-8")
        _check_events(path, text)
        config = parse_yaml(text)
    except ConfigError:
        raise
    except Exception as error:  # YAML's and the system's errors have no base
        raise ConfigError(str(path), f"cannot be read: {error}") from error
    if not isinstance(config, dict):
        raise ConfigError(str(path), f"expected keys and values, got {config!r}.")
    for key, value in _texts(config):
        if "${" in value:
            raise ConfigError(
                str(path), f"{key}: expected a plain value, got {value!r}, which is not evaluated."
            )
    return config


def _check_events(path: Path, text: str) -> None:
    depth = 0
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the former is much faster
    for event in yaml.parse(text, Loader=loader):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise ConfigError(str(path), "expected plain values, got references of YAML.")
        if getattr(event, "tag", None):
            raise ConfigError(str(path), f"expected plain values, got the tag {event.tag}.")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise ConfigError(str(path), f"expected at most {_MAX_DEPTH} levels of settings.")


def _texts(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """All texts among the values and keys, by dotted key."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _texts(str(key), f"{path}.{key}".lstrip("."))
            yield from _texts(item, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _texts(item, f"{path}[{i}]")
