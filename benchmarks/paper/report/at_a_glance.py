"""The paper's first figure: return, real samples and time of an action, over the six tasks."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from measures import Between
from phihp_torchrl.evaluation import PUBLISHED
from report.action_times import Turns, acting_time
from report.bounds import normalise
from report.claims import REDUCED, is_reduced
from report.efficiency import mean_samples
from report.paper_systems import PaperSystem, systems
from report.results import SIX_TASKS, Results
from report.sections import Picture, Section
from report.tables import NOT_RUN, Number, Table, TableCell

_PUBLISHED_VARIANTS = {"cartpole-swingup": "cartpole-swingup-published"}
"""The paper's number for a task is of this one, whose reward differs."""


@dataclass(frozen=True)
class _Compromise:
    """What a system is on the three metrics, each a mean over the six tasks."""

    score: float
    samples: Between | None
    milliseconds: float | None


def at_a_glance(results: Results, turns: Turns | None = None) -> Section:
    """A figure with a point for each system, and a table of its numbers.

    Args:
        results: the scores.
        turns: times of an action (:func:`~report.action_times.read_turns`).
    """
    reduced = f" {REDUCED}" if is_reduced(results) else ""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    samples_axis, time_axis = figure.subplots(1, 2, sharey=True)
    header = ["system", "normalised return", "real samples to 90 %", "ms for an action"]
    header += ["seeds", *(f"{name}, published" for name in header[1:])]
    rows: list[list[TableCell]] = []
    for i, system in enumerate(systems("ours", "baseline")):
        ours, theirs = _measured(results, turns or {}, system), _published(system)
        rows.append(
            [
                system.name,
                *_cells(ours, NOT_RUN),
                _seeds(results, system),
                *_cells(theirs, "–"),
            ]
        )
        for found, filled in ((ours, True), (theirs, False)):
            if found is not None:
                name = system.name if filled else f"{system.name}, published"
                _draw((samples_axis, time_axis), found, f"C{i}", name, filled=filled)
    samples_axis.set_xscale("symlog", linthresh=1000)
    samples_axis.set_xticks([0, 1_000, 10_000, 100_000])
    time_axis.set_xscale("log")
    samples_axis.set(xlabel="real samples to 90 %", ylabel="normalised return")
    time_axis.set(xlabel="ms for an action")
    for axis in (samples_axis, time_axis):
        axis.grid(alpha=0.3)
    if time_axis.get_legend_handles_labels()[0]:
        time_axis.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return Section(
        "At a glance",
        "Means over the six tasks, of a system that was run on all of them, with one share of the "
        "published real samples: of returns between bounds (`docs/evaluation.md`), of what the "
        "real samples to 90 % lie between, and of the time of an action, of compiled plans "
        "(`results/latency`). *Seeds* are those of a task, from the fewest to the most; a few say "
        "little. *Published*: the same from the paper's numbers, with its own CartPoleSwingup and "
        "on an Apple M1; nothing where it has none." + reduced,
        {"Over the six tasks": Table("at_a_glance", header, rows)},
        [
            Picture(
                "at_a_glance",
                figure,
                "Return against real samples and against the time of an action; hollow: published.",
            )
        ],
    )


def _measured(results: Results, turns: Turns, system: PaperSystem) -> _Compromise | None:
    """``None`` unless the system was run on all six tasks."""
    scores = results.averaged(system)
    if scores is None:
        return None
    preset = results.preset(system)
    times = [acting_time(turns, system, task, preset) for task in SIX_TASKS]
    known = [time for time in times if time is not None]
    return _Compromise(
        fmean(fmean(score.normalised for score in of_task) for of_task in scores),
        mean_samples(results, system, SIX_TASKS),
        fmean(known) if len(known) == len(SIX_TASKS) else None,
    )


def _seeds(results: Results, system: PaperSystem) -> str:
    """How many a task has, from the fewest to the most, such as ``"3–10"``."""
    counts = sorted({len(of_task) for of_task in results.averaged(system) or []})
    return "–".join(map(str, dict.fromkeys((counts[0], counts[-1])))) if counts else NOT_RUN


def _published(system: PaperSystem) -> _Compromise | None:
    """``None`` unless the paper has the system on all six tasks."""
    tasks = [_PUBLISHED_VARIANTS.get(task, task) for task in SIX_TASKS]
    rows = [PUBLISHED.get(task, {}).get(system.name) for task in tasks]
    known = [row for row in rows if row is not None]
    if len(known) < len(tasks):
        return None
    samples = [1000 * row.samples for row in known if row.samples is not None]
    return _Compromise(
        fmean(normalise(t, row.return_mean) for t, row in zip(tasks, known, strict=True)),
        Between(fmean(samples), fmean(samples)) if len(samples) == len(tasks) else None,
        fmean(row.milliseconds for row in known),
    )


def _cells(found: _Compromise | None, absent: str) -> list[TableCell]:
    if found is None:
        return [absent] * 3
    samples: TableCell = "–"
    if found.samples is not None:
        exact = found.samples.low == found.samples.high
        samples = f"{found.samples.high:.0f}" if exact else str(found.samples)
    return [Number(found.score), samples, Number(found.milliseconds)]


def _draw(
    axes: tuple[Axes, Axes], found: _Compromise, color: str, name: str, *, filled: bool
) -> None:
    face = color if filled else "none"
    samples_axis, time_axis = axes
    if found.samples is not None:
        low, high = found.samples.low, found.samples.high
        samples_axis.plot([low, high], [found.score] * 2, color=color, linewidth=1)
        samples_axis.plot(high, found.score, "o", color=color, markerfacecolor=face)
    if found.milliseconds is not None:
        time_axis.plot(
            found.milliseconds, found.score, "o", color=color, markerfacecolor=face, label=name
        )
