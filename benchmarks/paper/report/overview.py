"""The page over all settings: PhIHP's tables for each label, and where its numbers come from."""

from __future__ import annotations

from collections.abc import Sequence

from report.planned import Planned
from report.planner_and_actor import acting_section, returns_markdown
from report.runs import Run
from report.write import section_markdown


def overview(runs: Sequence[Run], planned: Planned | None = None) -> str:
    """The page, as Markdown."""
    planned = planned or Planned()
    labels = sorted({run.label for run in runs}, key=lambda label: (label != "default", label))
    parts = [
        "# Results\n\nMade by `python benchmarks/paper/make_report.py` from `results/runs/`. "
        "Do not edit. The paper's tables and figures, and its claims, are in "
        "[report/](report/README.md).\n"
    ]
    for label in labels:
        chosen = [run for run in runs if run.label == label and run.method == "phihp"]
        if not chosen:
            continue
        parts += [
            f"## {label}\n",
            "PhIHP; the commands in full are in `results/runs/*/metadata.json`. Mean ± std over "
            f"seeds, {_episodes(chosen)} evaluation episodes each, from seeds that no training "
            "uses. Where calibration lets the actor act, its return is that of the planner too. "
            f"{origins(chosen)}\n",
            "### Returns at the default preset's number of real samples, else at the most\n",
            returns_markdown(chosen),
            section_markdown(acting_section(chosen, planned.of(label)), level=2, title=False),
        ]
    if len(parts) == 1:
        parts.append("No runs yet.\n")
    return "\n".join(parts)


def origins(runs: Sequence[Run]) -> str:
    """Seeds, commits and machines."""
    seeds = ", ".join(str(seed) for seed in sorted({run.seed for run in runs}))
    commits = ", ".join(sorted({run.commit for run in runs}))
    machines = "; ".join(sorted({run.machine for run in runs}))
    counts = " or ".join(str(count) for count in sorted({run.threads for run in runs}))
    threads = "one thread" if counts == "1" else f"{counts} threads"
    return (
        f"Seeds: {seeds}. Commits: {commits}. Machine: {machines}, shared with other work; "
        f"{threads} a run, so times are upper bounds."
    )


def _episodes(runs: Sequence[Run]) -> str:
    """How many episodes an evaluation had; several numbers if it was not the same everywhere."""
    counts = {len(acting.returns) for run in runs for acting in run.acting.values()}
    return " or ".join(str(count) for count in sorted(counts))
