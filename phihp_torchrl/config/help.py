"""The text of ``--help``: the most important settings, with their values and a sentence each."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from phihp_torchrl.config.choices import YAML
from phihp_torchrl.config.compose import load_config
from phihp_torchrl.config.typed import flatten

FIRST = (
    "task",
    "world",
    "method",
    "preset",
    "budget",
    "seed",
    "model.real_steps",
    "policy.updates",
    "evaluate.episodes",
    "logger",
)
"""The ten settings that ``--help`` shows first."""


def sentences(text: str) -> dict[str, str]:
    r"""Collect the comment above each key of a YAML text, by dotted key.

    Args:
        text: YAML whose sections are indented by two spaces; entries of lists of one key count too.

    Examples:
        >>> sentences("policy:\n  # critic updates in all\n  updates: 8000\n")
        {'policy.updates': 'critic updates in all'}
    """
    found: dict[str, str] = {}
    path: list[str] = []
    comment: list[str] = []
    for line in text.splitlines():
        stripped = line.strip()
        if stripped.startswith("#"):
            comment.append(stripped.lstrip("# "))
        elif ":" in stripped:
            depth = 0 if stripped.startswith("- ") else (len(line) - len(line.lstrip())) // 2
            key = stripped.removeprefix("- ").split(":", 1)[0].removeprefix("override ")
            path = [*path[:depth], key]
            if comment:
                found.setdefault(".".join(path), " ".join(comment))
            comment = []
        else:
            comment = []
    return found


def sentences_of(cls: type) -> dict[str, str]:
    """The text of each field in the ``Args`` of a dataclass and its bases, without markup.

    Examples:
        >>> from phihp_torchrl.agents import TD3Config
        >>> sentences_of(TD3Config)["gamma"]
        'discount γ, or its time constant, such as "5 s".'
    """
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        doc = base.__dict__.get("__doc__") or ""
        section = re.search(r"^ *Args:\n(.*?)(?:\n *\n|\Z)", doc, re.S | re.M)
        if section is None:
            continue
        for part in re.split(r"\n(?= {8}\w+: )", section[1]):
            name, _, text = part.strip().partition(": ")
            found[name] = _without_markup(text)
    return found


def help_text(overrides: Sequence[str], config_dir: str | Path | None = None) -> str:
    """Return the text of ``--help`` for the task, method and preset that ``overrides`` name.

    Args:
        overrides: the words of the command line.
        config_dir: a directory of further YAML files.

    Raises:
        ConfigError: for a word that cannot be read or a name that there is no file of.
    """
    settings = load_config(overrides=overrides, config_dir=config_dir)
    groups = {"world": settings["world"]["kind"], "logger": settings["logger"]["name"]}
    values: dict[str, Any] = {**flatten(settings), **groups}
    values.setdefault("budget", _chosen("budget", overrides) or "full")
    words = sentences((YAML / "train.yaml").read_text(encoding="utf-8"))
    words = {**sentences((YAML / "defaults.yaml").read_text(encoding="utf-8")), **words}
    lines = [
        "usage: phihp train [setting=value ...] [--config-dir DIR] [--multirun] [--help]",
        "",
        f"The settings that matter most, as they are for task={settings['task']} "
        f"method={settings['method']}:",
        "",
    ]
    for key in FIRST:
        if key in values:
            lines += _entry(f"{key}={_short(values[key])}", words.get(key, ""))
    lines += [
        "",
        "phihp list                 tasks, methods, presets and worlds, a line each",
        "phihp train ... --cfg job  every setting of that run, with a sentence each",
        "phihp train resume=DIR     go on with a run that was stopped",
    ]
    return "\n".join(lines)


def settings_text(overrides: Sequence[str], config_dir: str | Path | None = None) -> str:
    """Every setting of the run that ``overrides`` name, as YAML with its sentences.

    Raises:
        ConfigError: for a word that cannot be read or a name that there is no file of.
    """
    settings = load_config(overrides=overrides, config_dir=config_dir)
    words = sentences((YAML / "train.yaml").read_text(encoding="utf-8"))
    words |= sentences((YAML / "defaults.yaml").read_text(encoding="utf-8"))
    for group, key in (("world", "kind"), ("planner", "kind"), ("logger", "name")):
        file = YAML / group / f"{(settings.get(group) or {}).get(key)}.yaml"
        if file.is_file():
            words |= {
                f"{group}.{k}": v for k, v in sentences(file.read_text(encoding="utf-8")).items()
            }
    path: list[str] = []
    lines = []
    for line in OmegaConf.to_yaml(OmegaConf.create(settings)).splitlines():
        indent = len(line) - len(line.lstrip())
        if ":" in line and not line.lstrip().startswith("-"):
            path = [*path[: indent // 2], line.strip().split(":", 1)[0]]
            if sentence := words.get(".".join(path)):
                lines.append(f"{' ' * indent}# {sentence}")
        lines.append(line)
    return "\n".join(lines)


def _without_markup(text: str) -> str:
    text = re.sub(r":\w+:`~?([^`]*\.)?([^`]*)`", r"\2", " ".join(text.split()))
    return text.replace("``", "")


def _chosen(group: str, overrides: Sequence[str]) -> str | None:
    chosen = [line.split("=", 1)[1] for line in overrides if line.startswith(f"{group}=")]
    return chosen[-1] if chosen else None


def _short(value: Any) -> str:
    return (
        "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    )


def _entry(setting: str, sentence: str) -> list[str]:
    wrapped = textwrap.wrap(sentence, 60)
    head = f"  {setting:<32} {wrapped[0] if wrapped else ''}".rstrip()
    return [head, *(f"{'':<35}{line}" for line in wrapped[1:])]
