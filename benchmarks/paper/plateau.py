"""What the stop at a plateau would have saved and lost on the runs that are kept.

    python benchmarks/paper/plateau.py

Replays the imagined returns that results/runs-0.1.0 has of default runs through the rule by which
the policy phase ends, for several values of ``policy.patience`` and ``policy.tail``. A kept run has
the mean of its returns alone. So every rise of more than 0.1 % counts here, where a run asks for
two standard errors as well and may end earlier; and rates do not fall early in a replay.
Writes results/plateau/README.md.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from measures import DEFAULT_SAMPLES
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.trainers import Plateau, PolicyConfig, Schedule

RUNS, RESULTS = Path("results/runs-0.1.0"), Path("results/plateau")
DEFAULT = (PolicyConfig.patience, PolicyConfig.tail)
TRIED = ((0.2, 0.1), (0.3, 0.15), DEFAULT)


class Curve(NamedTuple):
    """The imagined returns of a run: after how many updates, and how much."""

    updates: list[int]
    returns: list[float]


class AboveFloor:
    """The floor of returns of runs that have left it."""

    def share(self, returns: torch.Tensor) -> float:
        """No start is at the floor."""
        return 0.0


def curve(metrics: Path) -> Curve:
    """The curve of a run's ``metrics.csv``."""
    with metrics.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row.get("policy/imagined_return")]
    returns = [float(row["policy/imagined_return"]) for row in rows]
    return Curve([round(float(row["policy/updates"])) for row in rows], returns)


def curves(runs: Path) -> dict[tuple[str, int], list[Curve]]:
    """The curves of default runs by task and number of real samples."""
    found = defaultdict(list)
    for task, most in DEFAULT_SAMPLES.items():
        for path in sorted(runs.glob(f"{task}-default-n*-seed*/metrics.csv")):
            samples = int(path.parent.name.split("-n")[1].split("-")[0])
            if samples <= most:
                found[task, samples].append(curve(path))
    return {key: found[key] for key in sorted(found)}


def replay(run: Curve, patience: float, tail: float) -> tuple[float, float]:
    """The share of updates at which a run would have ended, and what its best actor had lost."""
    total = run.updates[-1]
    schedule = Schedule(total, decay=0.0)
    floor: Any = AboveFloor()
    every = run.updates[1] - run.updates[0]
    plateau = Plateau(schedule, patience, tail, round_to=every, floor=lambda: floor)
    best = -np.inf
    for updates, value in zip(*run, strict=True):
        if updates > schedule.end:
            break
        best = max(best, value)
        plateau.see(updates, torch.tensor([value]))
    return schedule.end / total, max(run.returns) - best


def rows(found: dict[tuple[str, int], list[Curve]]) -> list[list[str]]:
    """A row for each task and number of samples."""
    table = []
    for (task, samples), runs in found.items():
        best = np.mean([max(run.returns) for run in runs])
        row = [task, str(samples), str(len(runs)), f"{best:.1f}".replace("-", "−")]
        for patience, tail in TRIED:
            ends, losses = zip(*(replay(run, patience, tail) for run in runs), strict=True)
            row.append(f"{np.mean(ends):.2f}, {np.mean(losses):.2f} ({max(losses):.2f})")
        table.append(row)
    return table


def main(words: Sequence[str] | None = None) -> None:
    """Replay the kept runs, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=RUNS)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    header = ["task", "real samples", "runs", "best imagined return"]
    header += [f"{patience:g}, {tail:g}" for patience, tail in TRIED]
    origin = describe_origin(0)
    text = (
        "# Where a plateau would have ended learning\n\n"
        "Made by `python benchmarks/paper/plateau.py`. Do not edit. The kept default runs "
        "(training seeds below 100, imagined returns alone), replayed for values of "
        "`policy.patience` and `policy.tail`; the last are the defaults. In a cell: the share of "
        "all updates at which a run ends, then what its best actor loses in imagined return, mean "
        "(largest). In a replay learning rates do not fall early, which is where late gains come "
        "from; and a rise need not be beyond two standard errors, for a run keeps the mean of its "
        "returns alone, so a run itself may end earlier.\n\n"
        f"{markdown_table(header, rows(curves(arguments.runs)))}\n"
        f"Made at {commit_text(origin)}, {machine_text(origin)}.\n"
    )
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "README.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
