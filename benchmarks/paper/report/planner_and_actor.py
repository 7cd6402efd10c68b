"""PhIHP by itself: agent and actor apart, planning's gain, fewer samples, time of each phase."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import product

from measures import (
    PUBLISHED_SAMPLES,
    Difference,
    agent_in,
    holm,
    mean_of_seeds,
)
from phihp_torchrl.evaluation import TARGETS, TaskResult, returns_table
from report.comparison import numbers, unless_mixed
from report.paper_systems import AGENT, system
from report.planned import Planned, samples_of
from report.results import usual_samples
from report.runs import Run
from report.sections import Section
from report.tables import Number, Stat, Table, TableCell

_SHARES = {
    "all samples": 1.0,
    "a half": 0.5,
    "a tenth": 0.1,
    "a twentieth": 0.05,
    "a fiftieth": 0.02,
    "a hundredth": 0.01,
}
_WAYS = (AGENT, "actor")
_WITH_ACTORS = ("phihp", "dd-phihp")


def both_ways(runs: Iterable[Run], method: str = "phihp") -> dict[tuple[str, int], list[Run]]:
    """A method's runs by task and number of samples: the paper's order, many samples before few.

    Those whose calibration lets the actor act are among them, as any run whose actor was played.
    """
    groups = defaultdict(list)
    for run in runs:
        if run.method == method and "actor" in run.acting:
            groups[run.task, run.samples].append(run)
    order = {task: i for i, task in enumerate(PUBLISHED_SAMPLES)}
    return dict(
        sorted(groups.items(), key=lambda item: (order.get(item[0][0], len(order)), -item[0][1]))
    )


def usual_groups(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """PhIHP's runs at the usual number of real samples, by task."""
    groups = both_ways(runs)
    of_seeds: dict[str, list[int]] = {}
    for (task, samples), group in groups.items():
        of_seeds.setdefault(task, []).extend(samples for _ in {run.seed for run in group})
    return {task: groups[task, usual_samples(task, of)] for task, of in of_seeds.items()}


def means(group: Sequence[Run], way: str) -> list[float]:
    """The mean return of each run, by the actor or, with :data:`AGENT`, by the agent as saved."""
    return [run.acting[agent_in(run.acting) if way == AGENT else way].mean for run in group]


def returns_markdown(runs: Iterable[Run]) -> str:
    """The README's table: returns at the usual number of real samples."""
    results = []
    for task, group in usual_groups(runs).items():
        agent, actor = (tuple(means(group, way)) for way in _WAYS)
        results.append(TaskResult(task, group[0].samples, agent, actor))
    return returns_table(results)


def planning_gain(group: Sequence[Run]) -> Difference:
    """Agent less actor over the same episodes; each seed, which is one agent, counts once.

    A seed whose calibration lets the actor act gains exactly nothing, and counts as any other.
    """
    agent, actor = (means(group, way) for way in _WAYS)
    found = mean_of_seeds([a - b for a, b in zip(agent, actor, strict=True)])
    assert found is not None  # a group has runs
    return unless_mixed(found, group)


def acting_section(runs: Sequence[Run], planned: Planned | None = None) -> Section:
    """The tables on planning's gain, fewer samples and time."""
    planned = planned or Planned()
    groups = both_ways(runs)
    return Section(
        "PhIHP, planner and actor",
        "Each training seed counts once. The agent is as it was saved: it plans, or its actor acts "
        "where calibration said so, and then the difference is nil. What planning adds is "
        "exploratory here, with p-values adjusted by Holm over the table; it is judged under *The "
        "paper's claims*. The times are means, those of plans over the seeds that plan.",
        {
            "What planning adds to the actor, the same episodes": _gain_table(groups, planned),
            "Returns with fewer real samples": _samples_table(runs),
            "Time": _time_table(groups),
        },
    )


def _gain_table(groups: dict[tuple[str, int], list[Run]], planned: Planned) -> Table:
    found = {key: planning_gain(group) for key, group in groups.items()}
    tested = {key for key, gain in found.items() if not math.isnan(gain.p)}
    asked = {(cell.task, samples_of(cell)) for cell in planned.cells if cell.method == "phihp"}
    adjusted = holm([gain.p for gain in found.values()], len(tested | asked))
    rows: list[list[TableCell]] = [
        [task, str(samples), *numbers(gain, p, 2), str(gain.seeds[0])]
        for ((task, samples), gain), p in zip(found.items(), adjusted, strict=True)
    ]
    header = ["task", "real samples", "agent − actor", "95 % from", "to", "p", "seeds"]
    return Table("planning_gain", header, rows)


def _samples_table(runs: Sequence[Run]) -> Table:
    """Returns of PhIHP and of its twin without a prior, at each share of the published samples."""
    rows: list[list[TableCell]] = []
    by_system = {system(method).name: both_ways(runs, method) for method in _WITH_ACTORS}
    for task, published in PUBLISHED_SAMPLES.items():
        for (name, groups), way in product(by_system.items(), _WAYS):
            row: list[TableCell] = [f"{task}, {name}, {way}"]
            for share in _SHARES.values():
                group = groups.get((task, round(published * share)), [])
                row.append(Stat(tuple(means(group, way))))
            rows.append([*row, Number(TARGETS[task], 0, fixed=True) if task in TARGETS else "–"])
    return Table("fewer_samples", ["return (seeds)", *_SHARES, "target"], rows)


def _time_table(groups: dict[tuple[str, int], list[Run]]) -> Table:
    rows: list[list[TableCell]] = []
    for (task, samples), group in groups.items():
        model, policy = ([run.seconds[phase] for run in group] for phase in ("model", "policy"))
        both = [sum(pair) for pair in zip(model, policy, strict=True)]
        acting = [
            Stat(tuple(run.acting[way].latency["mean"] for run in group
                       if way in run.acting and "mean" in run.acting[way].latency))
            for way in ("planner", "actor")
        ]  # fmt: skip
        seconds = [Stat(tuple(values), 0) for values in (model, policy, both)]
        rows.append([task, str(samples), *seconds, *acting])
    header = ["task", "real samples", "model, s", "policy, s", "both, s", "plan, ms", "actor, ms"]
    return Table("time", header, rows)
