"""What a calibration has found, in a record, the log and a table."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from phihp_torchrl.config import kind_mapping
from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers.calibrate_choice import Trial
from phihp_torchrl.trainers.calibrate_end import End
from phihp_torchrl.trainers.calibrate_rule import Choice, Finalist
from phihp_torchrl.trainers.files import write_atomically

_log = logging.getLogger(__name__)


def summary(choice: Choice, end: End) -> dict[str, Any]:
    """The record of a choice, in plain values."""
    ways = end.finalists()
    record: dict[str, Any] = {
        "acting": choice.acting,
        "certain": choice.certain,
        "reason": choice.reason,
        "changes": dict(choice.plan.changes),
        "gain": choice.gain,
        "gain_error": choice.gain_error,
        "episodes": end.episodes,
        "steps": end.steps,
        "planner_return": _mean(choice.plan),
        "actor_return": _mean(ways["actor"]),
        "planner_chatter": choice.plan.mean_chatter,
        "actor_chatter": ways["actor"].mean_chatter,
        "given_return": _mean(ways["given"]),
        "given_chatter": ways["given"].mean_chatter,
    }
    if "other" in ways:
        ahead, error = ways["other"].ahead_of(ways["given"])
        record["other"] = {
            "changes": dict(ways["other"].changes),
            "return": _mean(ways["other"]),
            "chatter": ways["other"].mean_chatter,
            "ahead": ahead,
            "ahead_error": error,
        }
    return record


def report(final: Mapping[str, Any]) -> None:
    """Log a record; a choice in doubt is a warning that says what to do."""
    _log.info(
        "In imagination the plan with %s (%s) earns %+.4g ± %.2g beside the actor (chatter %.3f "
        "and %.3f); the %s acts.",
        final["changes"] or "the settings as given",
        final["reason"],
        final["gain"],
        final["gain_error"],
        final["planner_chatter"],
        final["actor_chatter"],
        final["acting"],
    )
    if not final["certain"]:
        _log.warning(
            "Whether the plan or the actor earns more is in doubt after %d imagined episodes; the "
            "%s acts. Raise calibrate.max_episodes and calibrate.budget to know better.",
            final["episodes"],
            final["acting"],
        )


def write_table(
    path: Path,
    final: Mapping[str, Any],
    planner: SearchConfig,
    rounds: Sequence[Sequence[Trial]],
) -> None:
    """Write the record, the planner's settings and every trial as JSON."""
    table = [
        {**asdict(trial), "gain": trial.mean, "gain_error": trial.standard_error}
        for trials in rounds
        for trial in trials
    ]
    content = {**final, "planner": kind_mapping(planner), "trials": table}
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def _mean(way: Finalist) -> float:
    return sum(way.returns) / len(way.returns)
