"""How long a run is expected to take: by an earlier one like it, or by committed ones."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, differences, load_config, to_mapping
from phihp_torchrl.display import duration
from phihp_torchrl.trainers.evaluate import EvaluateConfig
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.run_request import read_run_config

_RATES = Path(__file__).with_name("rates.json")  # benchmarks/speed/rates.py writes it
_EARLIER = 5
"""Runs beside this one that are looked at, from the newest."""

_NAMED = 3
"""Settings unlike those of the committed runs that are named."""

_LATER = "The time left is measured as the run goes on."


@dataclass(frozen=True)
class Expected:
    """The time that each phase is expected to take, and from where that is known.

    Args:
        low: seconds by phase that one run in ten stays below; ``None`` where nobody knows.
        middle: seconds that half of the runs stay below.
        high: seconds that nine runs in ten stay below.
        source: from where that is known.
    """

    low: dict[str, float | None]
    middle: dict[str, float | None]
    high: dict[str, float | None]
    source: str

    def words(self) -> str:
        """A sentence for the start of a run.

        Examples:
            >>> Expected({"model": 9.0}, {"model": 10.0}, {"model": 15.0}, "one run").words()
            'Expected: 9 s to 15 s, by one run. The time left is measured as the run goes on.'
        """
        unknown = [name for name, seconds in self.middle.items() if seconds is None]
        if len(unknown) == len(self.middle):
            return f"Nobody knows how long it takes. {_LATER}"
        low, high = (sum(s or 0.0 for s in of.values()) for of in (self.low, self.high))
        ends = (duration(low), duration(high))
        span = ends[0] if ends[0] == ends[1] else " to ".join(ends)
        more = f" without {', '.join(unknown)}, of which nobody knows" if unknown else ""
        return f"Expected: {span}{more}, by {self.source}. {_LATER}"


def expect(config: RunConfig, path: Path) -> Expected:
    """How long the phases of a run are expected to take.

    A finished run beside it whose phases had the same settings tells it best, since it was on this
    machine. Otherwise committed runs of the same method, preset and task do, in proportion to the
    amount of work. They had the default settings: those that differ, and on which the time depends
    in a way that is not known, are named. Nothing is expected of phases that neither has.

    Args:
        config: settings of the run.
        path: its directory.

    Examples:
        >>> found = expect(RunConfig("pendulum-swingup"), Path("nowhere/run"))
        >>> sorted(found.middle), found.low["policy"] < found.high["policy"]
        (['calibrate', 'evaluate', 'model', 'policy'], True)
    """
    names = config.phases_to_do
    earlier = _earlier(config, path)
    if earlier is not None:
        seconds = {name: earlier.get(name) for name in names}
        return Expected(seconds, seconds, seconds, "the last run of these settings beside it")
    rates = json.loads(_RATES.read_text(encoding="utf-8"))
    of = rates["seconds"].get(f"{config.method}/{config.preset}/{config.task}", {})
    ends: list[dict[str, float | None]] = [{}, {}, {}]
    for name in names:
        per = rates["per"].get(name)
        amount = getattr(config.section(name), per) if per else 1
        if name == "evaluate":  # fewer than these take hardly less, for they are played at once
            amount = max(1.0, config.section(name).episodes / EvaluateConfig().episodes)
        for end, rate in zip(ends, of.get(name) or (None,) * 3, strict=True):
            end[name] = None if rate is None else rate * amount
    about = rates["from"]
    source = (
        f"committed runs of it (version {' and '.join(about['versions'])}, on "
        f"{' or '.join(about['machines'])}, shared with other work)"
    )
    if of:
        source += _unlike(config, {f"{name}.{key}" for name, key in rates["per"].items()})
    return Expected(ends[0], ends[1], ends[2], source)


def _unlike(config: RunConfig, amounts: set[str]) -> str:
    """What is unlike the committed runs, in words; the amounts of work are reckoned with."""
    usual = load_config(config.task, method=config.method, preset=config.preset)
    ours, theirs = _work(config), _work(read_run_config(usual))
    shared = ours.keys() & theirs.keys()  # a phase that one of them skips is no setting
    ours, theirs = ({k: v for k, v in of.items() if k in shared} for of in (ours, theirs))
    found = [
        f"{key}={value}"
        for key, value, _ in differences(ours, theirs)
        if key not in {*amounts, "evaluate.episodes"}
    ]
    if not found:
        return ""
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return f" with default settings, unlike them here: {', '.join(found[:_NAMED])}{more}"


def _earlier(config: RunConfig, path: Path) -> dict[str, float] | None:
    """Seconds by phase of the newest finished run beside this one that did the same work."""
    candidates = [p for p in path.parent.glob("*/metadata.json") if p.parent != path]
    candidates.sort(key=lambda p: p.stat().st_mtime, reverse=True)
    for candidate in candidates[:_EARLIER]:
        try:
            directory = RunDirectory(candidate.parent)
            seconds = directory.read_metadata().get("seconds")
            if not seconds or not set(config.phases_to_do) <= set(seconds):
                continue
            theirs = directory.read_config()
        except (ConfigError, OSError):
            continue
        if all(theirs.get(key) == value for key, value in _work(config).items()):
            return {name: float(value) for name, value in seconds.items()}
    return None


def _work(config: RunConfig) -> dict[str, Any]:
    """The settings on which the duration depends: of phases to do, planner, world and process."""
    sections = {name: to_mapping(config.section(name)) for name in config.phases_to_do}
    ours = config.to_mapping()
    return {
        **sections,
        **{
            key: ours.get(key)
            for key in ("task", "method", "planner", "world", "compile", "threads")
        },
    }
