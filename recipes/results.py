"""Make every table of results from the runs in results/runs/.

    python recipes/results.py

Writes results/README.md, and the main table into README.md between its markers.
"""

from __future__ import annotations

import csv
import json
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from phihp_torchrl.evaluation import (
    PUBLISHED_SAMPLES,
    TARGETS,
    TaskResult,
    markdown_table,
    mean_and_std,
    paired_difference,
    returns_table,
)

RUNS = Path("results/runs")
START, END = "<!-- results:start -->", "<!-- results:end -->"


@dataclass(frozen=True)
class Run:
    """What a finished run left behind."""

    task: str
    label: str
    samples: int
    seed: int
    commit: str
    machine: str
    seconds: dict[str, float]
    returns: dict[str, torch.Tensor]
    latency: dict[str, float]
    last: dict[str, float]


def read_run(directory: Path) -> Run | None:
    """Read a run's text files; ``None`` if it is of another method than PhIHP."""
    config = yaml.safe_load((directory / "config.yaml").read_text())
    if config.get("method", "phihp") != "phihp":  # runs before there were methods are PhIHP's
        return None
    metadata = json.loads((directory / "metadata.json").read_text())
    evaluation: dict[str, Any] = json.loads((directory / "evaluation.json").read_text())
    session = metadata["sessions"][0]
    last: dict[str, float] = {}
    with open(directory / "metrics.csv", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            last |= {key: float(value) for key, value in row.items() if _is_number(value)}
    machine = session["machine"]
    return Run(
        task=config["task"],
        label=directory.name.removeprefix(config["task"] + "-").split("-n")[0],
        samples=config["model"]["real_steps"],
        seed=config["seed"],
        commit=session["commit"][:7] + ("+" if session["dirty"] else ""),
        machine=f"{machine['cpus']} cores, {machine['memory_gib']:.0f} GiB, {machine['gpus']} GPUs",
        seconds=metadata["seconds"],
        returns={name: torch.tensor(part["returns"]) for name, part in evaluation.items()},
        latency={name: part["latency_ms_p50"] for name, part in evaluation.items()},
        last=last,
    )


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def group(runs: list[Run]) -> dict[tuple[str, int], list[Run]]:
    """Runs by task and number of samples: tasks as in the paper, from many samples to few."""
    groups = defaultdict(list)
    for run in runs:
        groups[run.task, run.samples].append(run)
    order = list(PUBLISHED_SAMPLES)
    return dict(sorted(groups.items(), key=lambda item: (order.index(item[0][0]), -item[0][1])))


def summarise(runs: list[Run]) -> TaskResult:
    """Mean returns by seed."""
    means = {
        name: tuple(run.returns[name].mean().item() for run in runs)
        for name in ("planner", "actor")
    }
    return TaskResult(runs[0].task, runs[0].samples, **means)


def difference_table(groups: dict[tuple[str, int], list[Run]]) -> str:
    """What planning adds to the actor, episode by episode."""
    rows = []
    for (task, samples), runs in groups.items():
        planner = torch.cat([run.returns["planner"] for run in runs])
        actor = torch.cat([run.returns["actor"] for run in runs])
        paired = paired_difference(planner, actor)
        verdict = "worse" if paired.is_worse else "no worse"
        rows.append(
            [task, str(samples), f"{paired.mean:.2f}", f"{paired.standard_error:.2f}", verdict]
        )
    header = ["task", "real samples", "planner − actor", "standard error", "beyond two of them"]
    return markdown_table(header, rows)


def efficiency_table(groups: dict[tuple[str, int], list[Run]]) -> str:
    """Returns by share of the published samples."""
    shares = (1.0, 0.5, 0.2, 0.1)
    rows = []
    for task, published in PUBLISHED_SAMPLES.items():
        for name in ("planner", "actor"):
            row = [f"{task}, {name}"]
            for share in shares:
                runs = groups.get((task, round(published * share)), [])
                result = mean_and_std([run.returns[name].mean().item() for run in runs])
                row.append(f"{result} ({len(runs)})" if runs else "not run")
            rows.append([*row, f"{TARGETS[task]:.0f}" if task in TARGETS else "–"])
    header = ["return (seeds)", "all samples", "a half", "a fifth", "a tenth", "target"]
    return markdown_table(header, rows)


def time_table(groups: dict[tuple[str, int], list[Run]]) -> str:
    """Seconds of each phase, and milliseconds of an action."""
    rows = []
    for (task, samples), runs in groups.items():
        parts = [mean_and_std([run.seconds[p] for run in runs], 0) for p in ("model", "policy")]
        total = mean_and_std([run.seconds["model"] + run.seconds["policy"] for run in runs], 0)
        acting = [mean_and_std([run.latency[n] for run in runs]) for n in ("planner", "actor")]
        rows.append([task, str(samples), *parts, total, *acting])
    header = ["task", "real samples", "model, s", "policy, s", "both, s", "plan, ms", "actor, ms"]
    return markdown_table(header, rows)


def origins(runs: list[Run]) -> str:
    """Where the figures come from."""
    commits = ", ".join(sorted({run.commit for run in runs}))
    machines = "; ".join(sorted({run.machine for run in runs}))
    return (
        f"Commits: {commits}. Machine: {machines}, shared with other work; one thread a run, "
        "so times are upper bounds."
    )


def main() -> None:
    """Write the tables."""
    found = [read_run(path.parent) for path in sorted(RUNS.glob("*/evaluation.json"))]
    runs = [run for run in found if run is not None]
    labels = sorted({run.label for run in runs}, key=lambda label: (label != "default", label))
    sections = [
        "# Results\n\nMade by `python recipes/results.py` from `results/runs/`. Do not edit.\n"
    ]
    for label in labels:
        chosen = [run for run in runs if run.label == label]
        groups = group(chosen)
        full = {group_runs[0].task: group_runs for group_runs in reversed(groups.values())}
        full = {task: full[task] for task in PUBLISHED_SAMPLES if task in full}
        main_table = returns_table(summarise(group_runs) for group_runs in full.values())
        seeds = " ".join(str(seed) for seed in sorted({run.seed for run in chosen}))
        sections += [
            f"## {label}\n",
            f"`python recipes/grid.py --label {label} --seeds {seeds}` (commands in full in "
            "`results/runs/*/metadata.json`): mean ± std over seeds, 50 evaluation episodes each, "
            f"from seeds that no training uses. {origins(chosen)}\n",
            "### Returns at the most real samples that were used\n",
            main_table,
            "### What planning adds to the actor, the same episodes\n",
            difference_table(groups),
            "### Returns with fewer real samples\n",
            efficiency_table(groups),
            "### Time\n",
            time_table(groups),
        ]
        if label == "default":
            used = [run for group_runs in full.values() for run in group_runs]
            fill_readme(f"{main_table}\nSeeds {seeds}. {origins(used)}\n")
    Path("results/README.md").write_text("\n".join(sections))


def fill_readme(table: str) -> None:
    """Put the main table between the README's markers, if it has them."""
    readme = Path("README.md")
    text = readme.read_text() if readme.is_file() else ""
    if START in text and END in text:
        before, rest = text.split(START)
        readme.write_text(f"{before}{START}\n{table}{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
