"""Whether PhIHP acts faster than TD-MPC, by the turns that ``latency.py`` measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np
from scipy import stats

from report.paper_systems import TD_MPC, PaperSystem
from report.results import TASKS
from report.verdicts import NOT_SHOWN, REFUTED, SHOWN, Finding

Turns = Mapping[str, Mapping[str, Sequence[float]]]
"""Milliseconds for an action in each turn, by task and way to act."""

WIDTHS = ("published", "reduced")
"""TD-MPC's networks: the paper's, and those that are affordable here."""

MODES = ("eager", "compiled")
"""Both ways to act are compared in the same one."""


def read_turns(directory: Path) -> Turns:
    """Those that are kept in a directory; none where there is no such directory."""
    paths = sorted(directory.glob("*.json"))
    return {path.stem: json.loads(path.read_text())["turns"] for path in paths}


def acting_time(turns: Turns, system: PaperSystem, task: str) -> float | None:
    """Milliseconds for an action of a system as it is used: compiled where it plans.

    TD-MPC's are those of the reduced width, which its runs here have.
    """
    name = f"{system.name}, {WIDTHS[1]}" if system == TD_MPC else system.name
    for mode in reversed(MODES):
        if found := turns.get(task, {}).get(f"{name}, {mode}"):
            return median(found)
    return None


def faster(turns: Turns) -> list[Finding]:
    """TD-MPC's time of an action over PhIHP's, by its width, by mode and by task.

    The two took turns in one process, so that the ratio is of turns that follow one another, and
    the interval is of its median over turns.
    """
    findings = []
    for width, mode, task in product(WIDTHS, MODES, TASKS):
        found = turns.get(task, {})
        ours, theirs = found.get(f"PhIHP, {mode}"), found.get(f"TD-MPC, {width}, {mode}")
        if ours and theirs:
            findings.append(_of_turns(f"TD-MPC, {width}, {mode} on {task}", ours, theirs))
    return findings


def _of_turns(what: str, ours: Sequence[float], theirs: Sequence[float]) -> Finding:
    """Shown where the interval is above 1, refuted where it is below."""
    ratios = np.array(theirs) / np.array(ours)
    interval = stats.bootstrap(
        (ratios,), np.median, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    verdict = SHOWN if interval.low > 1 else REFUTED if interval.high < 1 else NOT_SHOWN
    return Finding(
        what,
        verdict,
        f"{median(ours):.1f} ms against {median(theirs):.1f}, {np.median(ratios):.1f} times",
        "–",
        f"{interval.low:.1f} to {interval.high:.1f} times",
        f"{len(ratios)} turns",
    )
