"""Learning curves: over real samples for all systems, over updates for the imagined policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from phihp_torchrl.evaluation import PUBLISHED
from report.bounds import normalise
from report.efficiency import points_by_seed
from report.learning_curve import draw_learning_curves, held, learning_curve
from report.paper_systems import PHIHP, TD3, PaperSystem, systems
from report.results import SIX_TASKS, Results
from report.sections import Picture, Section

Curves = Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]]


def learning_curves(results: Results) -> Section:
    """Return over real samples, by task and over tasks."""
    compared = systems("ours", "baseline")
    panels = {task: sample_curves(results, compared, task) for task in results.tasks}
    over_tasks = {}
    missing = []
    for system in compared:
        by_task = {task: points_by_seed(results.whole(system, task)) for task in SIX_TASKS}
        if all(by_task.values()):
            over_tasks[system.name] = [mean_over_tasks(by_task)]
        else:
            missing.append(system.name)
    text = (
        "A thin line for each seed, a thick one for their mean; a system that learns its policy in "
        "a model has a point for each number of samples that it was given, of the seeds that were "
        "given all of them. Between two evaluations a return stays what it was."
    )
    if missing:
        text += f" Not run on all six tasks, so not in the average: {', '.join(missing)}."
    published = {task: rows[PHIHP.name].return_mean for task, rows in PUBLISHED.items()}
    figure_by_task = _panels(panels, "real samples", published)
    figure = learning_curve(
        over_tasks, title="mean of six tasks", xlabel="real samples", ylabel="normalised return"
    )
    samples = [x for curves in panels.values() for seeds in curves.values() for x, _ in seeds]
    right = 1.3 * max((max(x) for x in samples), default=10_000)
    for panel in (*figure.axes, *figure_by_task.axes):
        panel.set_xscale("symlog", linthresh=1000)
        panel.set_xticks([0, 1_000, 10_000, 100_000])
        panel.set_xlim(0, right)
    return Section(
        "Learning curves",
        text,
        pictures=[
            Picture("learning_curves", figure_by_task, "Return on each task."),
            Picture("learning_curves_over_tasks", figure, "Normalised return, mean of six tasks."),
        ],
    )


def imagined_curves(results: Results) -> Section:
    """TD3's return in the real world over its updates, imagined and real."""
    panels: dict[str, Curves] = {task: update_curves(results, task) for task in results.tasks}
    drawn = {name for curves in panels.values() for name in curves}
    missing = [system.name for system in (*systems("imagined"), TD3) if system.name not in drawn]
    text = (
        "Return of the noise-free actor in the real world during training; TD3-im-ph imagines with "
        "the hybrid model, TD3-im-dd with the data-driven one, TD3 takes real steps, one an update."
    )
    if missing:
        text += f" Not run, or without a curve: {', '.join(missing)}."
    return Section(
        "TD3 in imagination",
        text,
        pictures=[Picture("imagined_td3", _panels(panels, "updates"), "Return over updates.")],
    )


def sample_curves(results: Results, compared: Sequence[PaperSystem], task: str) -> Curves:
    """Real samples and returns of each seed, for the systems that were run."""
    curves = {}
    for system in compared:
        points = points_by_seed(results.whole(system, task)).values()
        if points:
            curves[system.name] = [tuple(zip(*seed, strict=True)) for seed in points]
    return curves  # type: ignore[return-value]


def update_curves(results: Results, task: str) -> Curves:
    """Updates and returns of each seed, at the usual number of real samples."""
    curves = {}
    for system in (*systems("imagined"), TD3):
        seeds = []
        for score in results.usual(system, task):
            points = [p for p in score.run.curve if p.acting == "actor" and p.updates == p.updates
                      and p.phase != "evaluate"]  # fmt: skip
            if points:
                seeds.append(([p.updates for p in points], [p.return_mean for p in points]))
        if seeds:
            curves[system.name] = seeds
    return curves


def mean_over_tasks(
    by_task: Mapping[str, Mapping[int, Sequence[tuple[int, float]]]],
) -> tuple[np.ndarray, np.ndarray]:
    """Mean normalised return over tasks and seeds, from where all of them have a return on.

    Args:
        by_task: for each task and seed, real samples and returns.

    Returns:
        Samples and means ``[k]``; between two evaluations a return stays what it was.

    Examples:
        >>> steps = {"cartpole": {0: [(10, 0.0), (30, 500.0)]}, "acrobot": {0: [(20, -250.0)]}}
        >>> [values.tolist() for values in mean_over_tasks(steps)]
        [[20, 30], [0.25, 0.75]]
    """
    grid = np.unique([x for seeds in by_task.values() for pts in seeds.values() for x, _ in pts])
    start = max(points[0][0] for seeds in by_task.values() for points in seeds.values())
    grid = grid[grid >= start]
    means = []
    for task, seeds in by_task.items():
        lines = []
        for points in seeds.values():
            x, y = np.array([p[0] for p in points]), [normalise(task, p[1]) for p in points]
            lines.append(held(x, np.array(y), grid))
        means.append(np.mean(lines, axis=0))
    return grid, np.mean(means, axis=0)


def _panels(
    panels: Mapping[str, Curves], xlabel: str, published: Mapping[str, float] | None = None
) -> Figure:
    """A panel for each task, with the published return of PhIHP as a line."""
    columns = 4
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.8 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    drawn = [system.name for system in systems() if any(system.name in p for p in panels.values())]
    for axis, (task, curves) in zip(axes, panels.items(), strict=False):
        level = (published or {}).get(task)
        levels = {} if level is None else {"PhIHP, published": level}
        draw_learning_curves(axis, curves, levels, drawn)
        axis.set(xlabel=xlabel, ylabel="return", title=task)
        if not curves:
            axis.text(0.5, 0.5, "not run", ha="center", va="center", transform=axis.transAxes)
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    return figure
