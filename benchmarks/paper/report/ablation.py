"""The ablation: what each part of PhIHP is worth, on the three metrics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from statistics import fmean

from matplotlib.figure import Figure

from measures import Between
from report.bounds import BOUNDS
from report.efficiency import mean_samples, samples_cell
from report.paper_systems import PaperSystem, systems
from report.results import SIX_TASKS, Results, Score
from report.sections import Picture, Section
from report.tables import NOT_RUN, Stat, Table, TableCell

SAMPLES = "real samples to 90 %"


def ablation(results: Results) -> Section:
    """Bars over the tasks that all systems which were run have in common, and a table of all."""
    compared = systems("ours", "ablation")
    run = [s for s in compared if any(results.has_run(s, task) for task in SIX_TASKS)]
    common = [task for task in SIX_TASKS if run and all(results.has_run(s, task) for s in run)]
    metrics: dict[str, Callable[[Score], float | None]] = {
        "normalised return": lambda score: score.normalised,
        "ms for an action": lambda score: score.milliseconds,
    }
    missing = [system.name for system in compared if system not in run]
    shared = ", ".join(common) or "no task, for none is shared"
    text = (
        f"Bars: the mean over tasks of the means over seeds, on {shared}; of real samples, what "
        "that mean lies between, where it is known. Times are those of runs, which compile nothing "
        "and share the machine."
    )
    if missing:
        text += f" Not run: {', '.join(missing)}."
    digits = (3, 2)
    rows: list[list[TableCell]] = []
    for task, system in product((*SIX_TASKS, *results.others), compared):
        scores, note = results.usual(system, task), results.samples_note(system, task)
        stats: list[TableCell] = [
            # Returns of a task without bounds are on no scale.
            "–" if i == 0 and task not in BOUNDS else Stat(tuple(_known(scores, value)), n, note)
            for i, (value, n) in enumerate(zip(metrics.values(), digits, strict=True))
        ]
        rows.append([f"{task}, {system.name}", *stats, samples_cell(results, system, task)])
    figure = Figure(figsize=(11.0, 3.4), layout="constrained")
    axes = dict(zip((*metrics, SAMPLES), figure.subplots(1, len(metrics) + 1), strict=True))
    for x, system in enumerate(compared):
        for name, axis in axes.items():
            ends = _bar(results, system, common, metrics.get(name))
            if ends is None:
                absent = "not known" if system in run else NOT_RUN
                axis.text(x, 0.05, absent, rotation=90, ha="center", va="bottom",
                          transform=axis.get_xaxis_transform())  # fmt: skip
            else:
                axis.bar(x, ends.high - ends.low, bottom=ends.low, color=f"C{x}")
    for name, axis in axes.items():
        names = [system.name for system in compared]
        axis.set_xticks(range(len(names)), names, rotation=30, fontsize="small")
        axis.set_xlim(-0.6, len(names) - 0.4)
        axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
        axis.set_title(name)
        axis.grid(axis="y", alpha=0.3)
    return Section(
        "Ablation",
        text,
        {"By task": Table("ablation", ["task, system", *metrics, SAMPLES], rows)},
        [Picture("ablation", figure, "PhIHP and its variants on the three metrics.")],
    )


def _known(scores: Sequence[Score], value: Callable[[Score], float | None]) -> list[float]:
    return [found for score in scores if (found := value(score)) is not None]


def _bar(
    results: Results,
    system: PaperSystem,
    tasks: Sequence[str],
    value: Callable[[Score], float | None] | None,
) -> Between | None:
    """The ends of a bar: from 0 to a mean over tasks, or what the mean of samples lies between.

    Args:
        results: all scores.
        system: the system.
        tasks: those that the mean is over.
        value: of a score; ``None`` for the samples.
    """
    scores = results.averaged(system, tasks)
    if not scores:
        return None
    if value is None:
        return mean_samples(results, system, tasks)
    values = [_known(of_task, value) for of_task in scores]
    return Between(0.0, fmean(map(fmean, values))) if all(values) else None
