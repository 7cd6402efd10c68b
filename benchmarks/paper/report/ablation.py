"""The ablation: what each part of PhIHP is worth, on the three metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product

from matplotlib.figure import Figure

from measures import mean_between
from report.bounds import BOUNDS
from report.efficiency import sample_efficiency, samples_cell
from report.paper_systems import PaperSystem, systems
from report.results import SIX_TASKS, Results
from report.sections import Picture, Section
from report.tables import Stat, Table, TableCell

SAMPLES = "real samples to 90 %"


def ablation(results: Results) -> Section:
    """Bars over the tasks that all systems which were run have in common, and a table of all."""
    compared = systems("ours", "ablation")
    run = [s for s in compared if any(results.has_run(s, task) for task in SIX_TASKS)]
    common = [task for task in SIX_TASKS if run and all(results.has_run(s, task) for s in run)]
    metrics: dict[str, Callable[[PaperSystem, str], Sequence[float]]] = {
        "normalised return": lambda s, t: [x.normalised for x in results.usual(s, t)],
        "ms for an action": lambda s, t: [
            x.milliseconds for x in results.usual(s, t) if x.milliseconds is not None
        ],
    }
    missing = [system.name for system in compared if system not in run]
    shared = ", ".join(common) or "no task, for none is shared"
    text = (
        f"Bars: mean ± std over the runs on {shared}; of real samples, what their mean lies "
        "between."
    )
    if missing:
        text += f" Not run: {', '.join(missing)}."
    digits = (3, 2)
    rows: list[list[TableCell]] = []
    for task, system in product((*SIX_TASKS, *results.others), compared):
        stats: list[TableCell] = [
            # Returns of a task without bounds are on no scale.
            "–" if i == 0 and task not in BOUNDS else Stat(tuple(values(system, task)), n)
            for i, (values, n) in enumerate(zip(metrics.values(), digits, strict=True))
        ]
        rows.append([f"{task}, {system.name}", *stats, samples_cell(results, system, task)])
    figure = Figure(figsize=(11.0, 3.4), layout="constrained")
    axes = dict(zip((*metrics, SAMPLES), figure.subplots(1, len(metrics) + 1), strict=True))
    for x, system in enumerate(compared):
        for name, axis in axes.items():
            if system not in run or not common:
                axis.text(x, 0.05, "not run", rotation=90, ha="center", va="bottom",
                          transform=axis.get_xaxis_transform())  # fmt: skip
            elif name == SAMPLES:
                found = [sample_efficiency(results, system, task) for task in common]
                ends = mean_between([between for between in found if between is not None])
                axis.bar(x, ends.high - ends.low, bottom=ends.low, color=f"C{x}")
            else:
                columns = Stat(
                    tuple(v for task in common for v in metrics[name](system, task))
                ).columns()
                mean, std = float(columns[" mean"]), float(columns[" std"])
                axis.bar(x, mean, yerr=0.0 if math.isnan(std) else std, color=f"C{x}", capsize=3)
    for name, axis in axes.items():
        names = [system.name for system in compared]
        axis.set_xticks(range(len(names)), names, rotation=30, fontsize="small")
        axis.set_xlim(-0.6, len(names) - 0.4)
        axis.set_title(name)
        axis.grid(axis="y", alpha=0.3)
    return Section(
        "Ablation",
        text,
        {"By task": Table("ablation", ["task, system", *metrics, SAMPLES], rows)},
        [Picture("ablation", figure, "PhIHP and its variants on the three metrics.")],
    )
