"""Return over training, drawn: the seeds of each method and their mean."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

# Figures are made without pyplot: no window, no global state, and `savefig` draws with Agg.


def learning_curve(
    curves: Mapping[str, Sequence[tuple[ArrayLike, ArrayLike]]],
    *,
    title: str = "",
    xlabel: str = "real environment steps",
    ylabel: str = "return",
    reference: Mapping[str, float] | None = None,
) -> Figure:
    """Return over training: a thin line for each seed and, of several, a thick one for their mean.

    Args:
        curves: for each method, one ``(steps [k], returns [k])`` for each seed.
        title: title.
        xlabel: what the steps are.
        ylabel: what the returns are.
        reference: levels to draw as dashed lines, e.g. published returns.

    Returns:
        A figure; its steps are on a symlog axis if they span more than a factor of 50.
    """
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axis = figure.subplots()
    draw_learning_curves(axis, curves, reference)
    axis.set(xlabel=xlabel, ylabel=ylabel, title=title)
    return figure


def held(x: np.ndarray, y: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Returns ``y [k]`` of evaluations at ``x [k]`` as they stand at later places ``grid [n]``.

    Examples:
        >>> held(np.array([0, 10]), np.array([1.0, 2.0]), np.array([0, 5, 10, 15])).tolist()
        [1.0, 1.0, 2.0, 2.0]
    """
    return np.asarray(y)[np.searchsorted(x, grid, side="right") - 1]


def draw_learning_curves(
    axis: Axes,
    curves: Mapping[str, Sequence[tuple[ArrayLike, ArrayLike]]],
    reference: Mapping[str, float] | None = None,
    methods: Sequence[str] = (),
) -> None:
    """What :func:`learning_curve` draws, on an axis of a larger figure; a lone point is a dot.

    Args:
        axis: where to draw.
        curves: as there.
        reference: as there.
        methods: all that the figure has, so that each has one colour in it; by default, these.
    """
    largest, smallest = 0.0, math.inf
    order = methods or [*curves]
    for method, seeds in curves.items():
        color = f"C{order.index(method) % 10}"
        runs = [(np.asarray(x, dtype=float), np.asarray(y, dtype=float)) for x, y in seeds]
        runs = [(x, y) for x, y in runs if len(x)]
        for x, y in runs:
            one = len(runs) == 1
            axis.plot(x, y, color=color, linewidth=2 if one else 0.7, alpha=1 if one else 0.5,
                      marker="o" if len(x) == 1 else None, markersize=4, drawstyle="steps-post",
                      label=method if one else None)  # fmt: skip
            largest = max(largest, float(x.max()))
            smallest = min(smallest, *(float(v) for v in x[x > 0]), math.inf)
        if len(runs) > 1:
            # Where all seeds have begun and none has ended.
            grid = np.unique(np.concatenate([x for x, _ in runs]))
            low, high = max(x[0] for x, _ in runs), min(x[-1] for x, _ in runs)
            grid = grid[(grid >= low) & (grid <= high)]
            mean = np.mean([held(x, y, grid) for x, y in runs], axis=0)
            axis.plot(grid, mean, color=color, linewidth=2, marker="D" if len(grid) == 1 else None,
                      drawstyle="steps-post", label=f"{method} ({len(runs)} seeds)")  # fmt: skip
    for name, level in (reference or {}).items():
        axis.axhline(level, color="0.4", linestyle="--", linewidth=1, label=name)
    if largest > 50 * smallest:
        axis.set_xscale("symlog", linthresh=smallest)
    axis.grid(alpha=0.3)
    if curves or reference:
        axis.legend(fontsize="small")
