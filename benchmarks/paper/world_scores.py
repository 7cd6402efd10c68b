"""The table and the picture of ``worlds.py``: our runs beside the published scores of others."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measures import agent_in
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import commit_text, machine_text

PUBLISHED = "published.csv"
PLAYERS = {"planner": "PhIHP", "actor": "PhIHP, the actor alone"}
_COLORS = {"TD-MPC2": "C1", "DreamerV3": "C2", "SAC": "C3"}


@dataclass(frozen=True)
class Score:
    """What a method earns on a task after so many steps of the environment.

    Args:
        task: name of the task.
        method: who plays.
        steps: steps of the environment that were learned from.
        mean: return, the mean over training seeds.
        lowest: return of the worst seed.
        highest: return of the best seed.
        seeds: number of training seeds.
    """

    task: str
    method: str
    steps: int
    mean: float
    lowest: float
    highest: float
    seeds: int


def published(results: Path) -> list[Score]:
    """The scores of others; none if the file is not there."""
    path = results / PUBLISHED
    if not path.is_file():
        return []
    with path.open() as file:
        return [
            Score(
                row["task"],
                row["method"],
                int(row["environment_steps"]),
                float(row["mean"]),
                float(row["lowest"]),
                float(row["highest"]),
                int(row["seeds"]),
            )
            for row in csv.DictReader(file)
        ]


def ours(runs: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[Score]:
    """A score for each task and player, over the seeds that were run."""
    scores = []
    for name in names:
        found = [run for run in runs if run["task"] == name]
        for player, label in PLAYERS.items():
            returns = (run["returns"] for run in found)
            means = [
                float(np.mean(r[agent_in(r) if player == "planner" else player])) for r in returns
            ]
            if means:
                steps = max(run["environment_steps"] for run in found)
                spread = (float(np.mean(means)), min(means), max(means))
                scores.append(Score(name, label, steps, *spread, len(means)))
    return scores


def write_report(results: Path, names: Sequence[str]) -> None:
    """README.md and, where there is something to compare, scores.png.

    Args:
        results: the folder with a JSON file for each run.
        names: tasks, in the order of the table.
    """
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    mine, others = ours(runs, names), published(results)
    rows = []
    for name in names:
        aims = {run["target"] for run in runs if run["task"] == name}
        both = [s for s in mine if s.task == name] + [s for s in others if s.task == name]
        for s in both:
            aim = f"{max(aims):g}" if s in mine else ""
            spread = f"{s.lowest:.1f} to {s.highest:.1f}" if s.seeds > 1 else "one seed"
            cells = [name, s.method, f"{s.steps:,}", f"{s.mean:.1f}", spread, str(s.seeds), aim]
            rows.append([cell.replace("-", "−") if i in (3, 4, 6) else cell
                         for i, cell in enumerate(cells)])  # fmt: skip
    header = ["task", "method", "environment steps", "return", "seeds from", "seeds", "aim"]
    text = _INTRODUCTION + "\n" + markdown_table(header, rows)
    missing = [name for name in names if all(run["task"] != name for run in runs)]
    if missing:
        text += f"\nNot run yet: {', '.join(missing)}.\n"
    if single := [s.task for s in mine if s.seeds == 1 and s.method == PLAYERS["planner"]]:
        text += f"\nOne training seed only: {', '.join(single)}.\n"
    text += "".join(f"\n{_account(run)}" for run in runs)
    panels = [name for name in names if {name} & {s.task for s in others}]
    if panels:
        draw(results / "scores.png", panels, mine, others)
        text += "\n![returns by environment steps](scores.png)\n"
    if runs:
        text += f"\n{_origins(runs)}\n"
    (results / "README.md").write_text(text)


def brief(results: Path, names: Sequence[str]) -> str:
    """What somebody new wants to know first, for README.md: the tasks that others have played too.

    Args:
        results: the folder with a JSON file for each run, and the published scores.
        names: tasks, in the order of the table.
    """
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    others = published(results)
    rows, used = [], []
    for mine in ours(runs, names):
        theirs = {s.method: s for s in reversed(others) if s.task == mine.task}  # of fewest steps
        if mine.method == PLAYERS["planner"] and theirs:
            used += [run for run in runs if run["task"] == mine.task]
            spread = f"{mine.mean:.0f} ({mine.lowest:.0f} to {mine.highest:.0f})"
            row = [mine.task, str(mine.seeds), f"{mine.steps:,}", spread]
            rows.append([*row, *(_of(theirs.get(method)) for method in _COLORS)])
    header = ["task", "seeds", "environment steps", "return (seeds from … to)", *_COLORS]
    return f"{markdown_table(header, rows)}\n{_origins(used)}"


def _of(score: Score | None) -> str:
    return "–" if score is None else f"{score.mean:.0f} ({score.steps:,})"


def _origins(runs: Sequence[Mapping[str, Any]]) -> str:
    commits = sorted({commit_text(run["origin"]) for run in runs})
    machines = sorted({machine_text(run["origin"]) for run in runs})
    return f"Commits: {', '.join(commits)}. Machines: {'; '.join(machines)}."


_INTRODUCTION = """# Whole runs in worlds that others made

Made by `python benchmarks/paper/worlds.py`. Do not edit. Default settings throughout: a run is told
the textbook's equations with guesses 30 % off, stops and their kind, the simulator's integrator, a
reward, and at most how many steps to take (`benchmarks/paper/other_worlds`). Nothing else is set by
hand for a task. Actions of dm_control's tasks are held for two steps, and each of those counts as a
step of the environment. Our returns are means of 20 episodes in the world itself, from seeds that
no training uses. *PhIHP* is the agent as it is saved: its plans, or its actor where calibration in
imagination found that no plan earns more.

Scores of others on the same tasks, with the same action repeat, are those of TD-MPC2's public
result files. `published.csv` names file and commit in every row, and
`benchmarks/paper/published_scores.py` makes it. They learn from observations alone and are told no
equations, so the table says what knowing them is worth, and not which method is the better one.
"""


def _account(run: Mapping[str, Any]) -> str:
    """What a run says of its policy phase and its time."""
    kept = run["policy"].get("kept")
    strategy = f"kept the strategy {kept}, " if kept else ""
    seconds = ", ".join(f"{phase} {value:.0f} s" for phase, value in run["seconds"].items())
    imagined = run["metrics"].get("policy/best_imagined_return")
    promised = "" if imagined is None else f"its actor's imagined return is {imagined:.1f}, "
    return f"- {run['task']}, seed {run['seed']}: {promised}{strategy}{seconds}.\n"


def draw(path: Path, names: Sequence[str], mine: Sequence[Score], others: Sequence[Score]) -> None:
    """A panel for each task: curves of others, and our runs as points with their seeds' range."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(names), 3.4), layout="constrained")
    for axes, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        for method in dict.fromkeys(s.method for s in others):
            curve = [s for s in others if (s.task, s.method) == (name, method)]
            steps = [s.steps for s in curve]
            color = _COLORS.get(method)
            axes.plot(steps, [s.mean for s in curve], "o-", ms=3, color=color, label=method)
            low, high = [s.lowest for s in curve], [s.highest for s in curve]
            axes.fill_between(steps, low, high, color=color, alpha=0.15, lw=0)
        for s in (s for s in mine if s.task == name):
            reach = [[s.mean - s.lowest], [s.highest - s.mean]]
            mark = "*" if s.method == PLAYERS["planner"] else "x"
            axes.errorbar(s.steps, s.mean, reach, fmt=mark, ms=9, color="C0", label=s.method)
        axes.set(xscale="log", xlim=(1e3, 1.4e6), ylim=(-20, 1000), title=name)
        axes.set_xlabel("steps of the environment")
        axes.legend(fontsize=7, loc="best")
    figure.savefig(path, dpi=110)
