"""Compose the settings of a run from names and overrides; the only reader of the YAML files.

Settings come in layers, each of which overrides the one before: the defaults of the dataclasses,
the preset, the task's changes to that preset, the changes of method and budget, the command line.
Hydra composes the files. Nothing here imports torch, so that ``--help`` answers without delay.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phihp_torchrl.config.choices import choices_of, groups, offered, published_offers
from phihp_torchrl.config.errors import ConfigError, meant
from phihp_torchrl.config.methods import METHODS
from phihp_torchrl.config.overrides import (
    open_mappings,
    override_key,
    override_lines,
    parse_overrides,
    quoted,
)
from phihp_torchrl.config.typed import flatten

MODULE = "phihp_torchrl.config.settings"
"""Package of the YAML files, as Hydra addresses it."""

PLACES = ("run_dir", "resume", "trust")
"""Settings that say where a run is stored, and whether to trust it; no part of its settings."""

# The values of these are names of files, whose content is in the composed settings already.
_GROUPS = ("preset", "task", "method", "budget", "logger", "world", "planner")
_NAMES = ("task", "preset", "method")
_FIRST_PLANNER = "cem"  # the kind of planner that a layer's numbers are for if it names none


def load_config(
    task: str | None = None,
    *,
    method: str | None = None,
    preset: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    config_dir: str | Path | None = None,
) -> dict[str, Any]:
    """Compose the settings of a run, as ``phihp train`` composes them from the same words.

    Args:
        task: name of a task; by default ``pendulum-swingup``.
        method: name of a method; by default ``phihp``.
        preset: ``"default"`` or ``"paper"``.
        overrides: further settings, as on a command line (``["policy.updates=3000"]``) or as a
            mapping from dotted keys to values.
        config_dir: directory of additional YAML files, as for ``--config-dir``.

    Returns:
        Nested dictionaries of plain values. Their ranges are checked when a run reads them.

    Raises:
        ConfigError: for an unknown name or key, and for an override that cannot be parsed.

    Examples:
        >>> settings = load_config("acrobot", preset="paper", overrides=["policy.batch_size=32"])
        >>> settings["planner"]["alpha"], settings["policy"]["batch_size"]
        (0.8, 32)
    """
    named = {"task": task, "method": method, "preset": preset}
    lines = [f"{key}={name}" for key, name in named.items() if name is not None]
    lines += override_lines(overrides)
    return finish(compose_yaml(lines, config_dir), lines)


def compose_yaml(overrides: Sequence[str], config_dir: str | Path | None = None) -> Any:
    """Compose the YAML files and ``overrides`` with Hydra; :func:`finish` applies the last layers.

    Raises:
        ConfigError: for a key, value or file that Hydra refuses; the message names it.
    """
    lines = open_mappings(overrides)
    try:
        if config_dir is not None:
            return _compose(lines, config_dir)
        chosen, values = _split(lines)
        composed = copy.deepcopy(_compose_once(tuple(chosen), offered(chosen)))
        ConfigLoaderImpl._apply_overrides_to_config(values, composed)
        return composed
    except (HydraException, OmegaConfBaseException) as error:
        raise _explain(overrides, config_dir, error) from error


@contextmanager
def _apart() -> Iterator[None]:
    """A context in which Hydra may be set up anew, as in a job that it has composed."""
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = outer


@lru_cache(maxsize=32)
def _compose_once(lines: tuple[str, ...], offers: str) -> Any:
    """Compose choices of groups; a process often needs the same ones with other values."""
    return _compose(lines)


def _compose(lines: Sequence[str], config_dir: str | Path | None = None) -> Any:
    places = [] if config_dir is None else [config_dir]
    if config_dir is not None:
        path = quoted(f"file://{Path(config_dir).absolute()}")
        lines = [*lines, f"hydra.searchpath=[{path}]"]
    with (
        published_offers(*places),
        _apart(),
        initialize_config_module(MODULE, version_base="1.3"),
    ):
        return compose("train", [*lines])


def _split(lines: Sequence[str]) -> tuple[list[str], list[Override]]:
    """Words that decide which files are composed, and those that set values in what they make."""
    known = {*_GROUPS, *groups()}
    parsed = OverridesParser.create().parse_overrides(list(lines))
    chosen, values = [], []
    for word, line in zip(lines, parsed, strict=True):
        key = override_key(line)
        of_hydra = key in known or key.startswith("hydra") or "/" in key or line.package
        if of_hydra or line.is_sweep_override():
            chosen.append(word)
        else:
            values.append(line)
    return chosen, values


def _explain(
    overrides: Sequence[str], config_dir: str | Path | None, error: Exception
) -> ConfigError:
    """Turn Hydra's error into one that names the key and what is expected there."""
    lines = {override_key(line): line for line in parse_overrides(overrides)}
    for group in _GROUPS:
        if group in lines and not lines[group].is_sweep_override():
            chosen, known = str(lines[group].value()), choices_of(group, config_dir)
            if chosen not in known:
                hint = meant(chosen, known)
                return ConfigError(group, f"expected one of {known}, got {chosen!r}{hint}")
    choices = [word for word in overrides if word.split("=", 1)[0] in _GROUPS]
    if len(choices) < len(overrides):  # otherwise a choice is wrong and not a key
        composed: Any = OmegaConf.to_container(compose_yaml(choices, config_dir))
        known_keys = flatten(composed)
        for key in lines:
            if key not in (*_GROUPS, *known_keys) and not key.startswith(("hydra", "world.")):
                close = " or ".join(map(repr, _close(key, known_keys, _unread(composed))))
                hint = f"did you mean {close}?" if close else "phihp train --cfg job has all."
                return ConfigError(key, f"unknown key; {hint}")
    return ConfigError("settings", " ".join(str(error).split()))


def _unread(config: Mapping[str, Any]) -> set[str]:
    """Sections of the settings that the method does not read, as those of other methods."""
    method = METHODS.get(config.get("method") or "")  # one of a plugin may not be known yet
    every = {section for other in METHODS.values() for section in other.sections}
    return every.difference(method.sections) if method else set()


def _close(key: str, known: Collection[str], unread: Collection[str]) -> list[str]:
    """The known keys that may have been meant, those of the same section first.

    Args:
        key: dotted, and unknown. What it gives in seconds may be known in steps.
        known: all dotted keys.
        unread: sections that the method does not read; other sections' keys come before theirs.
    """
    section = _section(key)
    name = key[len(section) :].lstrip(".")
    stem = name.removesuffix("_seconds")
    last = stem.rpartition(".")[2]
    here = {k[len(section) :].lstrip("."): k for k in known if _section(k) == section}
    same = [k for k in here if k.rpartition(".")[2] == last]
    ending = [k for k in here if k.endswith(f"_{last}")]
    for names, words, cutoff in (
        (same, stem, 0),
        (ending, stem, 0),
        (here, stem, 0.6),
        (here, name, 0.6),
    ):
        if found := get_close_matches(words, names, n=1, cutoff=cutoff):
            return [here[found[0]]]
    elsewhere = [k for k in known if k.rpartition(".")[2] == last]
    read = [k for k in elsewhere if _section(k) not in unread]
    few = 1 if section else 3  # which section is meant, nobody knows
    return get_close_matches(stem, read or elsewhere, n=few, cutoff=0) or get_close_matches(
        key, known, n=1
    )


def _section(key: str) -> str:
    """The section of a dotted key; none of one that stands by itself."""
    return key.partition(".")[0] if "." in key else ""


def finish(composed: Any, overrides: Sequence[str]) -> dict[str, Any]:
    """Apply the layers of task, method and budget to the preset, and then the command line.

    A task's file has a section for each preset (``presets``); methods and budgets have a section
    of their changes (``changes``). Both are applied here, after Hydra, because a setting decides
    which preset's section applies.

    Args:
        composed: the settings that Hydra composed.
        overrides: the overrides of the command line.

    Raises:
        ConfigError: for a key in one of these sections that the settings do not have.
    """
    config: Any = OmegaConf.to_container(composed, resolve=True)
    presets, changes = config.pop("presets", None) or {}, config.pop("changes", None) or {}
    _name_columns(config)
    preset = presets.get(config.get("preset")) or {}
    for name, section in ((f"presets.{config.get('preset')}", preset), ("changes", changes)):
        section = _for_planner(section, config)
        _check_section(section, config, name)
        config = _merged(config, section)
    return apply_overrides(config, overrides)


def apply_overrides(config: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return ``config`` with the overrides of a command line applied; new keys are added.

    Raises:
        ConfigError: for text that cannot be parsed as an override.

    Examples:
        >>> apply_overrides({"policy": {"updates": 8000}}, ["policy.updates=10"])
        {'policy': {'updates': 10}}
    """
    lines = parse_overrides(overrides)
    sections = {re.split(r"[.\[]", override_key(line))[0] for line in lines}
    if any("${" in word for word in overrides):  # a value of any section
        sections = set(config)
    changed = OmegaConf.create({key: config[key] for key in config if key in sections})
    for line in lines:
        key = override_key(line)
        if key in _NAMES:
            changed[key] = str(line.value())
        elif key not in _GROUPS and not key.startswith("hydra"):
            OmegaConf.update(changed, key, line.value(), force_add=True)
    plain: Any = OmegaConf.to_container(changed, resolve=True)
    return {**copy.deepcopy(dict(config)), **plain}


def _merged(config: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``config`` with changes; mappings are merged, and other values replaced."""
    merged = dict(config)
    for key, value in changes.items():
        known = merged.get(key)
        both = isinstance(known, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(known, value) if both else value  # type: ignore[arg-type]
    return merged


def _name_columns(config: Any) -> None:
    """Give the columns that a task's file names to the world, if it is one that has columns."""
    columns = config.pop("columns", None) or {}
    if "columns" in (config.get("world") or {}):
        config["world"]["columns"] = {**columns, **config["world"]["columns"]}


def _for_planner(section: Mapping[str, Any], config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Drop a layer's planner settings if they are for another kind of planner."""
    numbers = section.get("planner")
    chosen = (config.get("planner") or {}).get("kind", _FIRST_PLANNER)
    if numbers is None or numbers.get("kind", _FIRST_PLANNER) == chosen:
        return section
    return {key: value for key, value in section.items() if key != "planner"}


def _check_section(section: Mapping[str, Any], config: Mapping[str, Any], path: str) -> None:
    """Refuse keys in a task's or a method's section that the settings do not have."""
    for key, value in section.items():
        name = f"{path}.{key}"
        if key not in config:
            raise ConfigError(name, f"unknown key; expected one of {sorted(config)}.")
        if isinstance(value, Mapping) and isinstance(config[key], Mapping):
            _check_section(value, config[key], name)
