"""What a calibration has found, in a record, the log and a table."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from phihp_torchrl.config import kind_mapping
from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers.calibrate_rule import Choice, Way
from phihp_torchrl.trainers.files import write_atomically

_log = logging.getLogger(__name__)

# Standard errors beyond which a difference is no chance; that few episodes were played remains.
_CLEAR = 4.0


def summary(choice: Choice, ways: Mapping[str, Way], actor: Way) -> dict[str, Any]:
    """The record of a choice, in plain values."""
    plan = ways[choice.name]
    return {
        "acting": choice.acting,
        "certain": choice.certain,
        "way": choice.name,
        "changes": dict(plan.changes),
        "gain": choice.gain,
        "gain_error": choice.gain_error,
        "episodes": len(actor.returns),
        "planner_return": plan.mean_return,
        "actor_return": actor.mean_return,
        "planner_chatter": plan.mean_chatter,
        "actor_chatter": actor.mean_chatter,
        "ways": {name: _row(way, actor) for name, way in ways.items()},
    }


def warn_of_doubt(own: float, elsewhere: Sequence[float]) -> None:
    """Warn that models disagree, and say what to do."""
    _log.warning(
        "The actor earns %.4g in the model and %s in others that fit the real steps about as well. "
        "So the planner's settings stay as given: what a calmer plan costs is not known. Take more "
        "real steps (model.real_steps).",
        own,
        " and ".join(f"{each:.4g}" for each in elsewhere),
    )


def report(final: Mapping[str, Any]) -> None:
    """Log a record; a choice in doubt is a warning that says what to do."""
    _log.info(
        "In imagination the %s plan (%s) earns %+.4g ± %.2g beside the actor (chatter %.3f and "
        "%.3f); the %s acts.",
        final["way"],
        final["changes"] or "the settings as given",
        final["gain"],
        final["gain_error"],
        final["planner_chatter"],
        final["actor_chatter"],
        final["acting"],
    )
    if (catch := final.get("catch")) is not None:
        _log.info(
            "Near the goal or the reference a regulator acts, not plans: %+.4g ± %.2g in "
            "imagination (chatter %.3f, and %.3f without it).",
            catch["gain"],
            catch["gain_error"],
            catch["chatter"],
            catch["chatter_before"],
        )
    if final["certain"]:
        return
    if abs(final["gain"]) > _CLEAR * final["gain_error"]:
        found = "One of plan and actor earns clearly more, but a rare failure may be missed in"
    else:
        found = "Whether the plan or the actor earns more is in doubt after"
    _log.warning(
        "%s %d imagined episodes; the %s acts. Raise calibrate.max_episodes and calibrate.budget "
        "to know better.",
        found,
        final["episodes"],
        final["acting"],
    )


def write_table(path: Path, final: Mapping[str, Any], planner: SearchConfig) -> None:
    """Write the record and the planner's settings as JSON."""
    content = {**final, "planner": kind_mapping(planner)}
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def _row(way: Way, actor: Way) -> dict[str, Any]:
    gain, error = way.ahead_of(actor)
    return {
        "changes": dict(way.changes),
        "episodes": len(way.returns),
        "return": way.mean_return,
        "chatter": way.mean_chatter,
        "gain": gain,
        "gain_error": error,
    }
