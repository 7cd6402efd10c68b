"""Code that stored settings name, and whether it is the code that a run was started with."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from phihp_torchrl.config import (
    ConfigError,
    digest_of,
    digest_of_values,
    is_own_signature,
    own_signature,
)

_log = logging.getLogger(__name__)

CONTROLLER = "model.collect.exploration.controller"
"""The setting that names what acts while real steps are collected, as ``module:function``."""


def named_code(settings: Mapping[str, Any]) -> dict[str, str]:
    """What a run of these settings imports and calls besides this package, by key.

    Examples:
        >>> named_code({"plugins": ["my_task.py"], "world": {"kind": "simulated"}})
        {'plugins[0]': 'my_task.py'}
        >>> named_code({"world": {"kind": "torchrl", "make": "my_rig:make_env"}})
        {'world.make': 'my_rig'}
    """
    plugins = settings.get("plugins") or ()
    plugins = [plugins] if isinstance(plugins, str) else plugins
    found = {f"plugins[{i}]": str(name) for i, name in enumerate(plugins)}
    world = settings.get("world")
    world = {"kind": world} if isinstance(world, str) else world or {}
    if isinstance(world, Mapping):
        if (make := world.get("make")) is not None:
            found["world.make"] = str(make).partition(":")[0]
        if ":" in str(name := world.get("id", "")):
            found["world.id"] = str(name).partition(":")[0]
        if world.get("options"):  # arguments of whatever is called
            found["world.options"] = json.dumps(world["options"], sort_keys=True, default=str)
    if (controller := controller_of(settings)) is not None:
        found[CONTROLLER] = controller.partition(":")[0]
    return found


def controller_of(settings: Mapping[str, Any]) -> str | None:
    """The controller that settings name; ``None`` for none."""
    value: Any = settings
    for key in CONTROLLER.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return None if value is None else str(value)


def sign(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """The record of the code that settings name, for the metadata of a run that is started.

    It has the digest of each file and a signature by a key of the user's, so that no stranger's
    folder can have a valid one.

    Returns:
        The record; ``None`` where no code is named.
    """
    named = named_code(settings)
    if not named:
        return None
    record: dict[str, Any] = {"named": named, "files": _digests(named)}
    try:
        return {**record, "signature": own_signature(_text(record, settings))}
    except OSError as error:
        _log.warning(
            "The code that this run names could not be signed (%s); to resume it, say trust=true.",
            error,
        )
        return record


def check_trusted(
    settings: Mapping[str, Any],
    record: Any,
    *,
    given: Sequence[str] = (),
    trust: bool = False,
    place: str = "",
) -> None:
    """Refuse stored settings that name other code than the run was started with, by this user.

    Args:
        settings: the settings, before anything of them is imported.
        record: what :func:`sign` returned when the run was started, as the folder has it.
        given: keys that the user has set on this command line; what they name is the user's wish.
        trust: whether the user trusts all that the folder names.
        place: the folder, for messages.

    Raises:
        ConfigError: naming the code and the flag that allows it.
    """
    named = {
        key: name
        for key, name in named_code(settings).items()
        if not any(key == one or key.startswith((f"{one}[", f"{one}.")) for one in given)
    }
    if trust or not named:
        return
    reason = "it was not started by this user on this machine"
    if isinstance(record, Mapping):
        reason = _changed(settings, record) or ""
    if reason:
        listed = ", ".join(f"{key}: {name}" for key, name in named.items())
        raise ConfigError(
            "trust",
            f"the run in {place} names code that would be imported and called ({listed}), and "
            f"{reason}. Read that code; if you trust it, name it again on the command line or say "
            "trust=true.",
        )


def _changed(settings: Mapping[str, Any], record: Mapping[str, Any]) -> str | None:
    """Why a record is not valid for settings; ``None`` if it is."""
    signed = {key: record.get(key) for key in ("named", "files")}
    if not is_own_signature(record.get("signature"), _text(signed, settings)):
        return "it was not started like this by this user on this machine"
    for name, digest in _digests(named_code(settings)).items():
        if (signed["files"] or {}).get(name) != digest:
            return f"{name} was changed since the run was started"
    return None


def _digests(named: Mapping[str, str]) -> dict[str, str | None]:
    """The digest of each file; ``None`` for what has none, such as a module built into Python."""
    names = [name for key, name in named.items() if key != "world.options"]
    digests = {}
    for name in names:
        path = _file_of(name)
        try:
            digests[name] = None if path is None else digest_of(path.read_bytes())
        except OSError:
            digests[name] = None
    return digests


def _file_of(name: str) -> Path | None:
    """The file that would be imported, found without an import."""
    if name.endswith(".py"):
        return Path(name)
    places: Sequence[str] | None = [os.getcwd(), *sys.path]
    spec = None
    for part in name.split("."):
        spec = PathFinder.find_spec(part, places)
        if spec is None:
            return None
        places = list(spec.submodule_search_locations or ())
    return Path(spec.origin) if spec is not None and spec.origin else None


def _text(record: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """What is signed: the modules, and which functions of them are called."""
    signed = {"record": record, "world": settings.get("world")}
    if (controller := controller_of(settings)) is not None:
        signed["controller"] = controller
    return digest_of_values(signed)
