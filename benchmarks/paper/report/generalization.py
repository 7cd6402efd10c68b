"""The generalization figure: errors on states that the data never visited, against return."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from measures import PREDICTION_STEPS, agent_in
from report.cells import cells
from report.results import Results
from report.runs import Run
from report.sections import Picture, Section
from report.tables import Stat, Table, TableCell

KINDS = {"hybrid": "hybrid", "data_driven": "data-driven"}
_ERROR = "coverage_median"


def generalization(results: Results) -> Section:
    """A point for each run whose model was measured."""
    groups = {
        (task, kind): measured(results, task, kind) for task in results.tasks for kind in KINDS
    }
    rows: list[list[TableCell]] = []
    for (task, kind), runs in groups.items():
        name = f"{task}, {KINDS[kind]}"
        for (_, method, samples), cell in cells(runs).items():
            errors = tuple(run.prediction[_ERROR] for run in cell)
            returns = Stat(tuple(map(final, cell)))
            rows.append([name, method, f"{samples:,}", Stat(errors, 5), returns])
        if not runs:
            rows.append([name, "–", "–", Stat(()), Stat(())])
    header = ["task, model", "method", "real samples", "error", "return"]
    columns = 4
    lines = -(-len(results.tasks) // columns)
    figure = Figure(figsize=(13.6, 2.8 * lines), layout="constrained")
    axes = figure.subplots(lines, columns).ravel()
    for axis, task in zip(axes, results.tasks, strict=False):
        axis.set(title=task, xlabel=f"error after {PREDICTION_STEPS} steps", ylabel="return")
        axis.set_xscale("log")
        axis.grid(alpha=0.3)
        for i, (kind, name) in enumerate(KINDS.items()):
            if runs := groups[task, kind]:
                x = [run.prediction[_ERROR] for run in runs]
                axis.scatter(x, [*map(final, runs)], color=f"C{i}", label=name, s=18)
                axis.legend(fontsize="small")
        if not (groups[task, "hybrid"] or groups[task, "data_driven"]):
            axis.text(0.5, 0.5, "not run", ha="center", transform=axis.transAxes)
    for axis in axes[len(results.tasks) :]:
        axis.set_axis_off()
    return Section(
        "Generalization",
        f"Median distance between true and predicted state after {PREDICTION_STEPS} steps, from "
        "states of the task's wide box under random actions of evaluation seeds, against the "
        "return of the same run: planner if it has one, else actor. The figure has the runs with "
        "all numbers of real samples; in the table a training seed counts once in a row.",
        {"Error and return": Table("generalization", header, rows)},
        [Picture("generalization", figure, "Prediction error on unseen states against return.")],
    )


def measured(results: Results, task: str, kind: str) -> Sequence[Run]:
    """The runs with a model of a kind whose errors were measured."""
    return [r for r in results.runs if (r.task, r.kind) == (task, kind) and _ERROR in r.prediction]


def final(run: Run) -> float:
    """The return of a run's agent, of its planner if it has one."""
    return run.acting[agent_in(run.acting)].mean
