"""Whether PhIHP acts faster than TD-MPC, by the turns that ``latency.py`` measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np

from measures import RESAMPLES
from report.paper_systems import PHIHP, TD_MPC, PaperSystem
from report.results import TASKS
from report.verdicts import NOT_SHOWN, REFUTED, SHOWN, Finding

Turns = Mapping[str, Mapping[str, Sequence[float]]]
"""Milliseconds for an action in each turn, by task and way to act."""

WIDTHS = ("published", "reduced")
"""TD-MPC's networks: the paper's, and those that are affordable here."""

MODES = ("eager", "compiled")
"""Both ways to act are compared in the same one."""


def read_turns(directory: Path) -> tuple[Turns, list[str]]:
    """The turns that are kept in a directory, and a sentence for each file that is not read."""
    found, problems = {}, []
    for path in sorted(directory.glob("*.json")):
        try:
            found[path.stem] = json.loads(path.read_text())["turns"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            problems.append(f"{path}: {type(error).__name__}: {error}")
    return found, problems


_NAMES = {
    (PHIHP, "default"): "PhIHP",
    (PHIHP, "paper"): "PhIHP, published",
    (TD_MPC, "default"): f"TD-MPC, {WIDTHS[1]}",
    (TD_MPC, "paper"): f"TD-MPC, {WIDTHS[0]}",
}
"""What the turns call systems whose sizes depend on the preset."""


def acting_time(turns: Turns, system: PaperSystem, task: str, preset: str | None) -> float | None:
    """Milliseconds for an action of a system as it is used: compiled where it plans.

    Args:
        turns: all that were measured.
        system: the system.
        task: name of the task.
        preset: that of its runs, whose sizes it has.
    """
    sized = {sizes for one, sizes in _NAMES if one == system}
    if sized and preset not in sized:
        return None
    name = _NAMES.get((system, preset or ""), system.name)
    for mode in reversed(MODES):
        if found := turns.get(task, {}).get(f"{name}, {mode}"):
            return median(found)
    return None


def faster(turns: Turns, preset: str | None = "default") -> list[Finding]:
    """TD-MPC's time of an action over that of PhIHP's preset, by TD-MPC's width, mode and task.

    All methods took turns in one process, so that the ratio is of turns of one round, and the
    interval, a percentile bootstrap, is of its median over rounds. It says how steady one process
    of one machine was, and is adjusted for nothing.
    """
    findings, name = [], _NAMES.get((PHIHP, preset or ""))
    for width, mode, task in product(WIDTHS, MODES, TASKS):
        found = turns.get(task, {})
        ours, theirs = found.get(f"{name}, {mode}"), found.get(f"TD-MPC, {width}, {mode}")
        if ours and theirs:
            findings.append(_of_turns(f"TD-MPC, {width}, {mode} on {task}", ours, theirs))
    return findings


def _of_turns(what: str, ours: Sequence[float], theirs: Sequence[float]) -> Finding:
    """Shown where the interval is above 1, refuted where it is below."""
    ratios = np.array(theirs) / np.array(ours)
    rows = np.random.default_rng(0).integers(len(ratios), size=(RESAMPLES, len(ratios)))
    low, high = np.quantile(np.median(ratios[rows], axis=1), [0.025, 0.975])
    verdict = SHOWN if low > 1 else REFUTED if high < 1 else NOT_SHOWN
    return Finding(
        what,
        verdict,
        f"{median(ours):.1f} ms against {median(theirs):.1f}, {np.median(ratios):.2f} times",
        "–",
        f"{low:.2f} to {high:.2f} times",
        f"{len(ratios)} turns",
    )
