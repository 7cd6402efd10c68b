"""The settings of a run as they are read from YAML and command lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from phihp_torchrl.config import (
    METHODS,
    PLACES,
    ConfigError,
    apply_overrides,
    finish,
    from_mapping,
    override_key,
    parse_overrides,
)
from phihp_torchrl.trainers.files import check_contained
from phihp_torchrl.trainers.phases import PHASES, unknown_phases
from phihp_torchrl.trainers.plugins import import_plugins
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.trust import check_trusted


@dataclass(frozen=True)
class RunRequest:
    """The run that a command line describes.

    Args:
        config: settings of the run.
        path: directory of the run; ``None`` for a new one.
        resume: whether to resume the run in that directory.
    """

    config: RunConfig
    path: str | None
    resume: bool


def read_request(composed: Any, overrides: Sequence[str]) -> RunRequest:
    """Read the settings that Hydra composed as a typed request, and import their plugins.

    Args:
        composed: the composed settings.
        overrides: the command line.

    Raises:
        ConfigError: for the first key that is unknown or has a wrong value, by its dotted name, and
            for a run to resume whose folder names code that this user did not start it with.
    """
    keys = [override_key(line) for line in parse_overrides(overrides)]
    settings = finish(composed, overrides)
    places = {key: settings.pop(key, None) for key in PLACES}
    trust = places.pop("trust", None) or False
    if not isinstance(trust, bool):
        raise ConfigError("trust", f"expected true or false, got {trust!r}.")
    for key, value in places.items():
        if value is not None and not isinstance(value, str):
            raise ConfigError(key, f"expected a directory, got {value!r}.")
    if places["resume"] is not None:
        if places["run_dir"] is not None:
            raise ConfigError("run_dir", "expected none with resume, which names the directory.")
        directory = RunDirectory(places["resume"])
        kept = directory.read_config()
        if "logger" in keys:
            kept["logger"] = settings["logger"]
        given = [line for line, key in zip(overrides, keys, strict=False) if key not in PLACES]
        settings = apply_overrides(kept, given)
        check_contained(directory.path)
        record = _code_of(directory)
        check_trusted(settings, record, given=keys, trust=trust, place=str(directory.path))
    config = read_run_config(settings, given=keys)
    path = places["resume"] or places["run_dir"]
    return RunRequest(config, path, resume=places["resume"] is not None)


def _code_of(directory: RunDirectory) -> Any:
    """The record of the code that a run was started with; ``None`` where it cannot be read."""
    try:
        return directory.read_metadata().get("code")
    except ConfigError:
        return None


def read_run_config(
    settings: Mapping[str, Any], given: Sequence[str] = (), *, imports: bool = True
) -> RunConfig:
    """Read plain settings as a :class:`RunConfig`, and import the plugins that they name.

    Args:
        settings: plain values by key, as :func:`~phihp_torchrl.load_config` returns them.
        given: keys that were set explicitly, which the method must use.
        imports: whether to import the plugins; settings from a stranger's folder may name any code.

    Raises:
        ConfigError: for a key that is unknown or missing, or has a wrong value; the message has its
            dotted name.

    Examples:
        >>> read_run_config({"task": "acrobot", "method": "td3", "td3": {"seed_steps": 5}})
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: td3.seed_steps: unknown key; did you mean 'real_steps'?
    """
    rest = {key: value for key, value in settings.items() if key not in (*PLACES, "presets")}
    if imports:
        import_plugins(rest.get("plugins") or ())
    method_name = rest.get("method", "phihp")
    method = METHODS.find(method_name)
    unknown_phases(method.phases)  # those of the package's own have settings from now on
    used = method.sections
    known = {*PHASES, *(name for each in METHODS.values() for name in each.phases), "planner"}
    sections = {}
    for name in sorted(known & set(rest)):
        if name not in used:
            rest.pop(name)
            if keys := [key for key in given if key.split(".")[0] == name]:
                raise ConfigError(
                    keys[0],
                    f"method {method_name!r} has no use for {name!r}; "
                    f"its sections are {list(used)}.",
                )
        elif name in PHASES:
            sections[name] = from_mapping(PHASES[name].config, rest.pop(name), name)
    if "sections" in rest:
        raise ConfigError("sections", "unknown key; phases are set by their own names.")
    return from_mapping(RunConfig, {**rest, "sections": sections})
