"""What TD-MPC2, DreamerV3 and SAC earn on dm_control, from TD-MPC2's public result files.

    git clone https://github.com/nicklashansen/tdmpc2
    python benchmarks/paper/published_scores.py tdmpc2

Reads results/<method>/<task>.csv of the commit that is checked out there, whose columns are step,
reward and seed. Steps are those of the environment: that repository evaluates every 50,000 actions,
each of which is held for two steps, and its files have a row for every 100,000. Writes
results/worlds/published.csv, each row with its source.
"""

from __future__ import annotations

import argparse
import csv
import io
import subprocess
from collections import defaultdict
from pathlib import Path

OUT = Path("results/worlds/published.csv")
REPOSITORY = "github.com/nicklashansen/tdmpc2"
METHODS = {"tdmpc2": "TD-MPC2", "dreamerv3": "DreamerV3", "sac": "SAC"}
TASKS = (
    "pendulum-swingup",
    "cartpole-swingup",
    "cartpole-swingup-sparse",
    "cartpole-balance",
    "cartpole-balance-sparse",
    "acrobot-swingup",
)
STEPS = (100_000, 200_000, 500_000, 1_000_000)
COLUMNS = ("task", "method", "environment_steps", "mean", "lowest", "highest", "seeds", "source")


def read(repository: Path, folder: str, task: str) -> list[list[str]]:
    """The rows for a method and a task, one for each of ``STEPS``."""
    commit = _git(repository, "rev-parse", "HEAD").strip()
    path = f"results/{folder}/{task}.csv"
    scores: dict[int, list[float]] = defaultdict(list)
    for row in csv.DictReader(io.StringIO(_git(repository, "show", f"{commit}:{path}"))):
        scores[int(float(row["step"]))].append(float(row["reward"]))
    rows = []
    for step in STEPS:
        found = scores[step]
        if not found:
            raise ValueError(f"{path}: expected scores at step {step}, found none.")
        numbers = (sum(found) / len(found), min(found), max(found))
        rows.append([task, METHODS[folder], str(step), *(f"{x:.1f}" for x in numbers)])
        rows[-1] += [str(len(found)), f"{REPOSITORY} {path} {commit}"]
    return rows


def _git(repository: Path, *words: str) -> str:
    command = ["git", "-C", str(repository), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Write the scores of all methods and tasks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("repository", type=Path, help="a clone of TD-MPC2's repository")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for task in TASKS:
            for folder in METHODS:
                writer.writerows(read(arguments.repository, folder, task))


if __name__ == "__main__":
    main()
