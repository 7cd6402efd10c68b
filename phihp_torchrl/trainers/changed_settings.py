"""The settings of a run that a command line must name to have them again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from phihp_torchrl.config import ConfigError, load_config
from phihp_torchrl.trainers.run_config import RunConfig

_ELSEWHERE = ("task", "method", "phases", "from", "plugins")
"""Settings that a command for another run has of its own."""
_CHOICES = {"world": ("kind", "simulated"), "planner": ("kind", "cem"), "logger": ("name", "csv")}
"""Sections that a file of settings begins: where its name is kept, and the usual one."""


def settings_of(config: Mapping[str, Any], config_dir: str | None = None) -> dict[str, Any]:
    """The settings that differ from the defaults of the run's task and method, by dotted key.

    Args:
        config: all settings of the run.
        config_dir: directory of additional YAML files that the run was composed with.

    Examples:
        >>> settings = load_config("pendulum", overrides=["actuator.lag=0.1", "seed=3"])
        >>> settings_of(settings)
        {'seed': 3, 'actuator': {'lag': 0.1}}
    """
    chosen = dict(_chosen(config))
    usual = _usual(config, chosen, config_dir)
    kept = {key: value for key, value in config.items() if key not in _ELSEWHERE and key in usual}
    for name, (key, _) in _CHOICES.items():  # which the choice of the file says
        if isinstance(section := kept.get(name), Mapping):
            kept[name] = {k: v for k, v in section.items() if k != key}
            usual[name] = {k: v for k, v in usual[name].items() if k != key}
        else:
            kept.pop(name, None)
    kept.pop("preset", None)
    different = {k: v for name in kept for k, v in _different(kept[name], usual[name], name)}
    return chosen | different


def _chosen(config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The files of settings that were chosen, where they are not the usual ones."""
    if (preset := config.get("preset", "default")) != "default":
        yield "preset", preset
    for name, (key, usual) in _CHOICES.items():
        section = config.get(name)
        value = section.get(key, usual) if isinstance(section, Mapping) else usual
        if value != usual:
            yield name, value


def _usual(
    config: Mapping[str, Any], chosen: Mapping[str, Any], config_dir: str | None
) -> dict[str, Any]:
    """What the task's defaults are; those of all tasks where nothing is known of it here."""
    task, method = config["task"], config.get("method", "phihp")
    try:
        return load_config(task, method=method, overrides=chosen, config_dir=config_dir)
    except ConfigError:
        usual = RunConfig(task, method).to_mapping()
        for name in usual.keys() & chosen.keys() & _CHOICES.keys():
            usual[name] = dict.fromkeys(config[name])
        return usual


def _different(ours: Any, usual: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Values that differ; a mapping whose names a user chose is one value."""
    if isinstance(ours, Mapping) and isinstance(usual, Mapping) and ours.keys() <= usual.keys():
        for key, value in ours.items():
            yield from _different(value, usual[key], f"{path}.{key}")
    elif ours != usual:
        yield path, ours
