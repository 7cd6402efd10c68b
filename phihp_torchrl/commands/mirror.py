"""Write the YAML that mirrors the dataclasses of settings: values and a sentence for each key.

    python -m phihp_torchrl.commands.mirror      # or: make config

A number has one home, the default of its dataclass, and a sentence one, the ``Args`` of its
docstring. The files in ``config/settings`` that this writes are there to be read, by people and by
``--help``, and are never edited; a test holds them to the dataclasses.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

import phihp_torchrl.tdmpc  # noqa: F401  (it registers its phase)
from phihp_torchrl.config import METHODS, YAML, default_of, sentences_of
from phihp_torchrl.identification import IdentifyConfig
from phihp_torchrl.planners import PLANNERS
from phihp_torchrl.trainers import PHASES, LoggerConfig, RunConfig
from phihp_torchrl.worlds import WORLDS

_HEAD = "# Written by `make config` from the dataclasses; do not edit."
_WIDTH = 100


def mirror() -> dict[Path, str]:
    """The files to be written, below :data:`~phihp_torchrl.config.YAML`, and their texts."""
    texts = {Path("defaults.yaml"): _defaults()}
    for group, kinds in (("world", WORLDS), ("planner", PLANNERS)):
        for name, kind in kinds.items():
            if kind.config.__module__.startswith("phihp_torchrl."):
                lines = [_HEAD, f"# {kind.about}", "", f"# which kind of {group}", f"kind: {name}"]
                text = "\n".join([*lines, *_section(kind.config, 0)])
                texts[Path(group, f"{name}.yaml")] = f"{text}\n"
    text = "\n".join([_HEAD, "# phihp identify: how recordings are fitted", ""])
    texts[Path("identify.yaml")] = "\n".join([text, *_section(IdentifyConfig, 0)]) + "\n"
    for name, about in (
        ("csv", "metrics.csv in the run directory, and nothing else"),
        ("tensorboard", "TensorBoard beside metrics.csv (extra tensorboard)"),
        ("wandb", "Weights & Biases beside metrics.csv"),
    ):
        lines = [_HEAD, f"# {about}", "", *_section(LoggerConfig, 0, {"name": name})]
        texts[Path("logger", f"{name}.yaml")] = "\n".join(lines) + "\n"
    return texts


def write() -> list[Path]:
    """Write the files that are not as they should be; returns them."""
    written = []
    for name, text in mirror().items():
        path = YAML / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            written.append(path)
    return written


def _defaults() -> str:
    lines = [
        "# @package _global_",
        _HEAD,
        "# Every setting with its default; presets, tasks, methods and command lines change them.",
        "",
    ]
    # Groups have files of their own, and the sections of the phases follow.
    lines += _section(
        RunConfig,
        0,
        {"task": None},
        leave_out=("task", "method", "preset", "world", "planner", "logger", "sections"),
    )
    for place, sentence in (
        ("run_dir", "directory of this run; null for a new one under outputs/<task>/"),
        ("resume", "directory of a run to go on with; it takes the configuration of that run"),
    ):
        lines += [f"# {sentence}", f"{place}: null"]
    lines += ["# whether to run code that the run to go on with names, whoever wrote it"]
    lines += ["trust: false"]
    for name, kind in PHASES.items():
        if kind.config.__module__.startswith("phihp_torchrl."):
            users = ", ".join(n for n, method in METHODS.items() if name in method.phases)
            lines += ["", f"# phase of {users}", f"{name}:", *_section(kind.config, 1)]
    return "\n".join(lines) + "\n"


def _section(
    cls: type,
    depth: int,
    changed: Mapping[str, Any] | None = None,
    leave_out: tuple[str, ...] = (),
) -> Iterator[str]:
    words, indent = sentences_of(cls), "  " * depth
    for f in fields(cls):
        key = f.metadata.get("key", f.name)
        if not f.init or f.name in leave_out:
            continue
        value = (changed or {}).get(f.name, default_of(f))
        sentence = words.get(f.name)
        if sentence is None:
            raise LookupError(f"{cls.__name__}.{f.name}: its docstring has no sentence for it.")
        for line in textwrap.wrap(sentence.removesuffix("."), _WIDTH - 2 - len(indent)):
            yield f"{indent}# {line}"
        if is_dataclass(value):
            yield f"{indent}{key}:"
            yield from _section(type(value), depth + 1)
        else:
            yield f"{indent}{key}: {_text(value)}"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.1e}" if abs(value) >= 1e6 else repr(value)
    if isinstance(value, tuple):
        value = list(value)
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


if __name__ == "__main__":
    for path in write():
        print(f"wrote {path.name}")  # noqa: T201 (a console command)
