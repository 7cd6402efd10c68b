"""Performance over runs, by task and over tasks, with intervals of a stratified bootstrap.

Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
https://arxiv.org/abs/2108.13264.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phihp_torchrl.report.parts import NOT_RUN, Cell, Interval, Number, Picture, Section, Table
from phihp_torchrl.report.results import SIX_TASKS, TASKS, Results
from phihp_torchrl.report.systems import SYSTEMS, System

METRICS = ("median", "IQM", "mean", "optimality gap")
OVER_TASKS = "six tasks"

_THRESHOLDS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True)
class Aggregate:
    """A system's performance over runs, and over tasks where there are several.

    Args:
        values: one for each of :data:`METRICS`, ``[4]``.
        low: lower ends of their 95 % intervals, ``[4]``.
        high: upper ends, ``[4]``.
        seeds: runs on each task.
    """

    values: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    seeds: int


def aggregates(scores: Mapping[str, NDArray[np.float64]], reps: int) -> dict[str, Aggregate]:
    """Median, interquartile mean, mean and optimality gap of each system.

    Args:
        scores: normalised returns ``[seeds, tasks]`` by system.
        reps: resamples of the bootstrap, the same ones at every call.

    Raises:
        ImportError: without the extra ``report``.
    """
    library, metrics = _rliable()

    def all_four(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(
            [
                metrics.aggregate_median(matrix),
                metrics.aggregate_iqm(matrix),
                metrics.aggregate_mean(matrix),
                metrics.aggregate_optimality_gap(matrix),
            ]
        )

    found = {}
    for name, matrix in scores.items():
        with _same_draws():
            values, ends = library.get_interval_estimates({name: matrix}, all_four, reps=reps)
        found[name] = Aggregate(values[name], ends[name][0], ends[name][1], len(matrix))
    return found


def profiles(
    scores: Mapping[str, NDArray[np.float64]], thresholds: NDArray[np.float64], reps: int
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Share of runs above each threshold ``[k]``, with the ends of its 95 % interval.

    Args:
        scores: normalised returns ``[seeds, tasks]`` by system.
        thresholds: normalised returns ``[k]``.
        reps: resamples of the bootstrap.

    Raises:
        ImportError: without the extra ``report``.
    """
    library, _ = _rliable()
    found: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = {}
    for name, matrix in scores.items():
        with _same_draws():
            values, ends = library.create_performance_profile(
                {name: matrix}, thresholds, custom_profile_func=_share_above, reps=reps
            )
        found[name] = (values[name], ends[name][0], ends[name][1])
    return found


def score_matrix(
    results: Results, system: System, tasks: Sequence[str]
) -> NDArray[np.float64] | None:
    """Normalised returns ``[seeds, tasks]``; ``None`` if some task was not run.

    Where tasks have been run with different numbers of seeds, the first ones of each are taken, as
    many as all have.
    """
    columns = [[s.normalised for s in results.usual(system, task)] for task in tasks]
    seeds = min(map(len, columns), default=0)
    return np.array([column[:seeds] for column in columns]).T if seeds else None


def aggregate_section(results: Results, reps: int) -> Section:
    """The paper's aggregate metrics and performance profiles."""
    groups = {OVER_TASKS: SIX_TASKS, **{task: (task,) for task in TASKS}}
    matrices: dict[str, dict[str, NDArray[np.float64]]] = {}
    for group, tasks in groups.items():
        found = ((s.name, score_matrix(results, s, tasks)) for s in SYSTEMS)
        matrices[group] = {name: matrix for name, matrix in found if matrix is not None}
    estimates = {group: aggregates(scores, reps) for group, scores in matrices.items()}
    return Section(
        "Performance over runs",
        "Normalised returns, a score for each seed; intervals are 95 % percentile bootstrap, "
        f"stratified by task, {reps} resamples (rliable). An interval of one seed is no interval. "
        "The six tasks are all but `cartpole-swingup-published`.",
        {
            "Over the six tasks": _over_tasks(estimates[OVER_TASKS]),
            **{f"By task: {metric}": _by_task(estimates, i) for i, metric in enumerate(METRICS)},
        },
        [
            Picture("aggregates", _aggregate_figure(estimates), "Aggregate metrics, 95 %."),
            Picture("profiles", _profile_figure(matrices, reps), "Performance profiles, 95 %."),
        ],
    )


def _over_tasks(found: Mapping[str, Aggregate]) -> Table:
    """A row for each system."""
    rows: list[list[Cell]] = []
    for system in SYSTEMS:
        one = found.get(system.name)
        seeds = Number(None if one is None else one.seeds)
        rows.append([system.name, seeds, *(_interval(one, i) for i in range(len(METRICS)))])
    return Table("aggregates_over_tasks", ["system", "seeds", *METRICS], rows)


def _by_task(estimates: Mapping[str, Mapping[str, Aggregate]], metric: int) -> Table:
    """A row for each task, a column for each system."""
    rows: list[list[Cell]] = [
        [task, *(_interval(estimates[task].get(system.name), metric) for system in SYSTEMS)]
        for task in TASKS
    ]
    name = METRICS[metric].replace(" ", "_").lower()
    return Table(f"aggregates_{name}", ["task", *(system.name for system in SYSTEMS)], rows)


def _interval(one: Aggregate | None, i: int) -> Cell:
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
    for axis, (group, scores) in zip(axes, matrices.items(), strict=True):
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


def _share_above(
    matrix: NDArray[np.float64], thresholds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of scores above each threshold ``[k]``, all at once: rliable's own loops over them."""
    return (matrix.reshape(-1, 1) > thresholds).mean(axis=0)


def _color(name: str) -> str:
    return f"C{[system.name for system in SYSTEMS].index(name) % 10}"


def _rliable():  # type: ignore[no-untyped-def]  # two modules
    try:
        from absl import logging
        from rliable import library, metrics
    except ImportError as error:
        raise ImportError(
            f"rliable: expected it for intervals, it cannot be imported ({error}); "
            "`pip install 'phihp_torchrl[report]'` brings it."
        ) from error
    # When logging is set up anew, absl closes the stream that was stderr when it was imported,
    # which someone may have put there for a while and want back.
    logging.get_absl_handler().python_handler.stream = sys.__stderr__
    return library, metrics


@contextmanager
def _same_draws() -> Iterator[None]:
    """The same resamples each time: rliable draws from NumPy's global generator alone."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
