"""PhIHP by itself: planner and actor apart, planning's gain, fewer samples, time of each phase."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence

from measures import PUBLISHED_SAMPLES, Difference, holm, paired_difference_of_seeds
from phihp_torchrl.evaluation import TARGETS, TaskResult, returns_table
from report.bounds import margin
from report.results import usual_samples
from report.runs import Run
from report.sections import Section
from report.significance import verdict
from report.tables import Number, Stat, Table, TableCell

_SHARES = {"all samples": 1.0, "a half": 0.5, "a fifth": 0.2, "a tenth": 0.1}
_WAYS = ("planner", "actor")


def both_ways(runs: Iterable[Run]) -> dict[tuple[str, int], list[Run]]:
    """PhIHP's runs by task and number of samples: the paper's order, many samples before few."""
    groups = defaultdict(list)
    for run in runs:
        if run.method == "phihp" and all(way in run.acting for way in _WAYS):
            groups[run.task, run.samples].append(run)
    order = {task: i for i, task in enumerate(PUBLISHED_SAMPLES)}
    return dict(
        sorted(groups.items(), key=lambda item: (order.get(item[0][0], len(order)), -item[0][1]))
    )


def usual_groups(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """PhIHP's runs at the usual number of real samples, by task."""
    groups = both_ways(runs)
    numbers: dict[str, list[int]] = {}
    for task, samples in groups:
        numbers.setdefault(task, []).append(samples)
    return {task: groups[task, usual_samples(task, of)] for task, of in numbers.items()}


def returns_markdown(runs: Iterable[Run]) -> str:
    """The README's table: returns at the usual number of real samples."""
    results = []
    for task, group in usual_groups(runs).items():
        planner, actor = (tuple(run.acting[way].mean for run in group) for way in _WAYS)
        results.append(TaskResult(task, group[0].samples, planner, actor))
    return returns_table(results)


def planning_gain(group: Sequence[Run]) -> Difference:
    """Planner less actor over the same episodes; each seed, which is one agent, counts once."""
    planner, actor = ([run.acting[way].mean for run in group] for way in _WAYS)
    found = paired_difference_of_seeds([p - a for p, a in zip(planner, actor, strict=True)])
    assert found is not None  # a group has runs
    return found


def acting_section(runs: Sequence[Run]) -> Section:
    """The tables on planning's gain, fewer samples and time."""
    groups = both_ways(runs)
    return Section(
        "PhIHP, planner and actor",
        "Each training seed counts once; p-values are adjusted by Holm over the table.",
        {
            "What planning adds to the actor, the same episodes": _gain_table(groups),
            "Returns with fewer real samples": _samples_table(groups),
            "Time": _time_table(groups),
        },
    )


def _gain_table(groups: dict[tuple[str, int], list[Run]]) -> Table:
    found = {key: planning_gain(group) for key, group in groups.items()}
    adjusted = holm([gain.p for gain in found.values()])
    rows: list[list[TableCell]] = []
    for ((task, samples), gain), p in zip(found.items(), adjusted, strict=True):
        numbers: list[TableCell] = [
            "–" if math.isnan(value) else Number(value, 2, fixed=True)
            for value in (gain.mean, gain.low, gain.high)
        ]
        shown: TableCell = "–" if math.isnan(p) else Number(p, 2)
        rows.append(
            [
                task,
                str(samples),
                *numbers,
                shown,
                str(gain.seeds[0]),
                verdict(gain, p, margin(task)),
            ]
        )
    header = ["task", "real samples", "planner − actor", "95 % from", "to", "p", "seeds"]
    return Table("planning_gain", [*header, "the planner is"], rows)


def _samples_table(groups: dict[tuple[str, int], list[Run]]) -> Table:
    rows: list[list[TableCell]] = []
    for task, published in PUBLISHED_SAMPLES.items():
        for way in _WAYS:
            row: list[TableCell] = [f"{task}, {way}"]
            for share in _SHARES.values():
                group = groups.get((task, round(published * share)), [])
                row.append(Stat(tuple(run.acting[way].mean for run in group)))
            rows.append([*row, Number(TARGETS[task], 0, fixed=True) if task in TARGETS else "–"])
    return Table("fewer_samples", ["return (seeds)", *_SHARES, "target"], rows)


def _time_table(groups: dict[tuple[str, int], list[Run]]) -> Table:
    rows: list[list[TableCell]] = []
    for (task, samples), group in groups.items():
        model, policy = ([run.seconds[phase] for run in group] for phase in ("model", "policy"))
        both = [sum(pair) for pair in zip(model, policy, strict=True)]
        acting = [
            Stat(tuple(run.acting[way].latency["p50"] for run in group
                       if "p50" in run.acting[way].latency))
            for way in _WAYS
        ]  # fmt: skip
        seconds = [Stat(tuple(values), 0) for values in (model, policy, both)]
        rows.append([task, str(samples), *seconds, *acting])
    header = ["task", "real samples", "model, s", "policy, s", "both, s", "plan, ms", "actor, ms"]
    return Table("time", header, rows)
