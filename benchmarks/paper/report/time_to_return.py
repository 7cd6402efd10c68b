"""From nothing to the published return: seconds, beside those of the published updates."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from measures import PUBLISHED_UPDATES
from phihp_torchrl.evaluation import PUBLISHED, TARGETS
from report.planner_and_actor import both_ways
from report.runs import Run
from report.sections import Section
from report.tables import Number, Stat, Table, TableCell

_BENCHMARK = ("A TD3 update of 64 transitions", "fused step, compiled")


def time_to_return(runs: Sequence[Run], benchmarks: Path) -> Section:
    """PhIHP's seconds until it first earned what the paper's did.

    Args:
        runs: runs with one label.
        benchmarks: what ``make bench`` wrote, for the time of a published update.
    """
    milliseconds = _update_milliseconds(benchmarks)
    rows: list[list[TableCell]] = []
    for (task, samples), group in both_ways(runs).items():
        whole = [run.seconds["model"] + run.seconds["policy"] for run in group]
        level = _level(task)
        if level is None:
            unknown: list[TableCell] = ["–"] * 3
            rows.append([task, str(samples), *unknown, Stat(tuple(whole), 0), "–", "–"])
            continue
        known, reached = median_seconds_to(group, level)
        budget = None if milliseconds is None else milliseconds * PUBLISHED_UPDATES[task] / 1e3
        ratio = budget / known if budget and known else None
        rows.append(
            [
                task,
                str(samples),
                Number(level, 0, fixed=True),
                f"{reached} of {len(group)}",
                Number(known, 0, fixed=True),
                Stat(tuple(whole), 0),
                Number(budget, 0, fixed=True),
                Number(ratio, 1, fixed=True),
            ]
        )
    header = ["task", "real samples", "return", "reached by", "median s to it", "s in all"]
    header += ["published updates, s", "times our s to it"]
    text = (
        "The return is the published one, our target where there is none. It is reached when the "
        "actor earns it in the real world at an evaluation during training, of 10 episodes and for "
        "the log alone, or at the end, in the final ones, by the actor or by plans, whose "
        "calibration counts then. The median is over all seeds, and one that never got there took "
        "longer than any. *In all* is phases 1 and 2. "
        "*Published updates* is the paper's number of TD3 updates times the median of "
        "ours at its batch of 64, from `make bench`: without imagining, and without a model."
    )
    table = Table("time_to_return", header, rows)
    return Section("From nothing to the published return", text, {"Seconds on one core": table})


def seconds_to(run: Run, level: float) -> float:
    """Seconds of a run until it earned ``level``; infinite if it never did.

    The actor's are those of an evaluation during training or of the phases 1 and 2, after which it
    is there. Plans are known when they have been calibrated too.
    """
    for point in run.curve:
        if point.phase != "evaluate" and point.return_mean >= level:
            return point.seconds
    learned = run.seconds["model"] + run.seconds["policy"]
    if "actor" in run.acting and run.acting["actor"].mean >= level:
        return learned
    if any(acting.mean >= level for acting in run.acting.values()):
        return learned + run.seconds.get("calibrate", 0.0)
    return math.inf


def median_seconds_to(runs: Sequence[Run], level: float) -> tuple[float | None, int]:
    """The median of these seconds, and how many runs got there.

    A run that never did took longer than any; a mean over the others would flatter.

    Returns:
        ``None`` for the median where most never did.
    """
    needed = [seconds_to(run, level) for run in runs]
    middle = median(needed)
    reached = sum(seconds < math.inf for seconds in needed)
    return middle if middle < math.inf else None, reached


def _level(task: str) -> float | None:
    """The published return, or else our target; ``None`` for a task that has neither."""
    return PUBLISHED[task]["PhIHP"].return_mean if task in PUBLISHED else TARGETS.get(task)


def _update_milliseconds(benchmarks: Path) -> float | None:
    """The benchmark's median, if it was run."""
    title, contender = _BENCHMARK
    if not benchmarks.is_file():
        return None
    rows = json.loads(benchmarks.read_text()).get(title, {}).get("rows", [])
    return next((float(row[1]) for row in rows if row[0] == contender), None)
