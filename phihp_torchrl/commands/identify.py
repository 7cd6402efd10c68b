"""``phihp identify``: what recordings or real steps say of a system's constants.

``--help`` answers without importing torch; the rest is in ``identifying.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from phihp_torchrl.commands.train import split_flags, task_of_world
from phihp_torchrl.commands.words import help_of, read_lines, read_words
from phihp_torchrl.config import YAML, ConfigError, check_count, flatten, sentences

_USAGE = "phihp identify task=NAME world=recorded world.files=logs/*.csv [setting=value ...]"


@dataclass(frozen=True)
class IdentifyJob:
    """What is identified, and from which real steps.

    Args:
        task: name of the task whose system is identified.
        world: where real steps come from; recorded, with world.files, or any other world.
        steps: real steps that are taken in a world that is not recorded.
        seed: of these steps.
        model: how they are chosen, as in phihp train; model.collect.random_hold=5 holds each random
            action for five steps.
        identify: how they are fitted; the settings below.
        out_dir: directory of the report; null for a new one under outputs/<task>/.
        plugins: Python files or modules to import, which register tasks and worlds.
        threads: intra-op threads.
    """

    task: str
    world: Any = "simulated"
    steps: int = 3000
    seed: int = 0
    model: Any = field(default_factory=dict)
    identify: Any = field(default_factory=dict)
    out_dir: str | None = None
    plugins: tuple[str, ...] = ()
    threads: int = 1

    def __post_init__(self) -> None:
        check_count(self, "steps", "threads")
        check_count(self, "seed", least=0)


def main(words: Sequence[str]) -> None:
    """Identify as the words say."""
    settings, config_dir = split_flags(words)
    if any(word in ("-h", "--help") for word in words):
        print(help_of(IdentifyJob, _USAGE))  # noqa: T201 (a console command)
        print(_settings())  # noqa: T201
        return
    try:
        settings += task_of_world(read_lines(settings))
        job = read_words(IdentifyJob, settings)
        from phihp_torchrl.commands.identifying import identify_as

        identify_as(job, settings, config_dir)
    except ConfigError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


def _settings() -> str:
    """The settings of the fit, from the file that mirrors them."""
    import yaml

    text = (YAML / "identify.yaml").read_text(encoding="utf-8")
    words = sentences(text)
    lines = [""]
    for key, value in flatten(yaml.safe_load(text)).items():
        lines.append(f"  {f'identify.{key}={value}':<40} {words.get(key, '')}")
    return "\n".join(lines)
