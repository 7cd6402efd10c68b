"""The paper's aggregate metrics and performance profiles, as tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from report.aggregate import METRICS, Aggregate, aggregates, profiles, score_matrix
from report.bounds import BOUNDS
from report.paper_systems import systems
from report.results import SIX_TASKS, Results
from report.sections import Picture, Section
from report.tables import NOT_RUN, Interval, Number, Table, TableCell

OVER_TASKS = "six tasks"
"""The group of tasks that averages are over, beside each task by itself."""

_THRESHOLDS = np.linspace(0.0, 1.0, 101)


def aggregate_section(results: Results, reps: int) -> Section:
    """Tables over the six tasks and by task, and two figures."""
    bounded = [task for task in results.tasks if task in BOUNDS]
    groups = {OVER_TASKS: SIX_TASKS, **{task: (task,) for task in bounded}}
    matrices: dict[str, dict[str, NDArray[np.float64]]] = {}
    for group, tasks in groups.items():
        found = ((s.name, score_matrix(results, s, tasks)) for s in systems())
        matrices[group] = {name: matrix for name, matrix in found if matrix is not None}
    estimates = {group: aggregates(scores, reps) for group, scores in matrices.items()}
    return Section(
        "Performance over runs",
        "Normalised returns, a score for each seed; intervals are 95 % percentile bootstrap, "
        f"stratified by task, {reps} resamples (rliable). An interval of one seed is no interval. "
        "The six tasks are all but `cartpole-swingup-published`; where they have different numbers "
        "of seeds, as many are taken of each as all have, the first ones, and a system whose tasks "
        "have different shares of the published samples is in no average.",
        {
            "Over the six tasks": _over_tasks(estimates[OVER_TASKS]),
            **{
                f"By task: {metric}": _by_task(estimates, bounded, i)
                for i, metric in enumerate(METRICS)
            },
        },
        [
            Picture("aggregates", _aggregate_figure(estimates), "Aggregate metrics, 95 %."),
            Picture("profiles", _profile_figure(matrices, reps), "Performance profiles, 95 %."),
        ],
    )


def _over_tasks(found: Mapping[str, Aggregate]) -> Table:
    """A row for each system."""
    rows: list[list[TableCell]] = []
    for system in systems():
        one = found.get(system.name)
        seeds = Number(None if one is None else one.seeds)
        rows.append([system.name, seeds, *(_interval(one, i) for i in range(len(METRICS)))])
    return Table("aggregates_over_tasks", ["system", "seeds", *METRICS], rows)


def _by_task(
    estimates: Mapping[str, Mapping[str, Aggregate]], tasks: Sequence[str], metric: int
) -> Table:
    """A row for each task, a column for each system."""
    rows: list[list[TableCell]] = [
        [task, *(_interval(estimates[task].get(system.name), metric) for system in systems())]
        for task in tasks
    ]
    name = METRICS[metric].replace(" ", "_").lower()
    return Table(f"aggregates_{name}", ["task", *(system.name for system in systems())], rows)


def _interval(one: Aggregate | None, i: int) -> TableCell:
    return NOT_RUN if one is None else Interval(one.values[i], one.low[i], one.high[i])


def _aggregate_figure(estimates: Mapping[str, Mapping[str, Aggregate]]) -> Figure:
    figure = Figure(figsize=(11.0, 1.9 * len(estimates)), layout="constrained")
    axes = figure.subplots(len(estimates), len(METRICS), squeeze=False)
    for row, (group, found) in zip(axes, estimates.items(), strict=True):
        names = [*found]
        for i, axis in enumerate(row):
            for y, name in enumerate(names):
                one, color = found[name], _color(name)
                axis.barh(y, one.high[i] - one.low[i], left=one.low[i], color=color, alpha=0.5)
                axis.plot([one.values[i]] * 2, [y - 0.4, y + 0.4], color=color, linewidth=2)
            axis.set_yticks(range(len(names)), names if i == 0 else [""] * len(names))
            axis.tick_params(labelsize="small")
            axis.use_sticky_edges = False
            axis.margins(x=0.1)
            axis.locator_params(axis="x", nbins=3)
            axis.set_title(METRICS[i] if i else f"{group}: {METRICS[i]}", fontsize="small")
            axis.grid(axis="x", alpha=0.3)
            if not names:
                axis.text(0.5, 0.5, "not run", ha="center", transform=axis.transAxes)
    return figure


def _profile_figure(matrices: Mapping[str, Mapping[str, NDArray[np.float64]]], reps: int) -> Figure:
    columns = 4
    rows = -(-len(matrices) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.8 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(matrices) :]:
        axis.set_axis_off()
    for axis, (group, scores) in zip(axes, matrices.items(), strict=False):
        for name, (middle, low, high) in profiles(scores, _THRESHOLDS, reps).items():
            axis.plot(_THRESHOLDS, middle, color=_color(name), label=name)
            axis.fill_between(_THRESHOLDS, low, high, color=_color(name), alpha=0.2, linewidth=0)
        axis.set(title=group, xlabel="normalised return τ", ylabel="share of runs > τ")
        axis.grid(alpha=0.3)
        if scores:
            axis.legend(fontsize="x-small")
        else:
            axis.text(0.5, 0.5, "not run", ha="center", transform=axis.transAxes)
    return figure


def _color(name: str) -> str:
    return f"C{[system.name for system in systems()].index(name) % 10}"
