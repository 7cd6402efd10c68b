"""Run tasks x seeds x shares of the published real samples, one process a run; keep what is small.

    python recipes/grid.py --tasks pendulum acrobot --seeds 0 1 2 --shares 1 0.1 --jobs 2

A finished run is skipped, one that was cut off goes on from its checkpoint. Overrides for
recipes/phihp.py follow after ``--``. Runs live in outputs/grid/; their configuration, metadata,
metrics and evaluation (all text) are copied to results/runs/, from where recipes/results.py makes
the tables.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from phihp_torchrl.evaluation import PUBLISHED_SAMPLES

OUTPUT = Path("outputs/grid")
RESULTS = Path("results/runs")
KEPT = ("config.yaml", "metadata.json", "metrics.csv", "evaluation.json")


def run_cell(task: str, seed: int, samples: int, label: str, overrides: list[str]) -> str:
    """Run one cell unless it is done; returns what became of it."""
    name = f"{task}-{label}-n{samples}-seed{seed}"
    directory = OUTPUT / name
    if (RESULTS / name / "evaluation.json").is_file():
        return f"{name}: done before"
    if (directory / "metadata.json").is_file():
        arguments = [f"resume={directory}"]
    else:
        arguments = [f"task={task}", f"seed={seed}", f"model.real_steps={samples}"]
        arguments += [f"run_dir={directory}", "progress=false", *overrides]
    OUTPUT.mkdir(parents=True, exist_ok=True)
    with open(OUTPUT / f"{name}.log", "a", encoding="utf-8") as log:
        command = [sys.executable, str(Path(__file__).with_name("phihp.py")), *arguments]
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False).returncode
    if code or not (directory / "evaluation.json").is_file():
        return f"{name}: failed with exit code {code}, see {OUTPUT / name}.log"
    (RESULTS / name).mkdir(parents=True, exist_ok=True)
    for file in KEPT:
        shutil.copyfile(directory / file, RESULTS / name / file)
    return f"{name}: done"


def main() -> None:
    """Run the grid."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=sorted(PUBLISHED_SAMPLES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--shares", nargs="+", type=float, default=[0.5])
    parser.add_argument("--label", default="default", help="name of the configuration in results/")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("overrides", nargs="*", help="for recipes/phihp.py, after --")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.tasks) - set(PUBLISHED_SAMPLES))
    if unknown:
        parser.error(f"--tasks: unknown {unknown}, expected some of {sorted(PUBLISHED_SAMPLES)}.")
    os.environ["OMP_NUM_THREADS"] = "1"
    cells = [
        (task, seed, round(PUBLISHED_SAMPLES[task] * share), arguments.label, arguments.overrides)
        for share in arguments.shares
        for seed in arguments.seeds
        for task in arguments.tasks
    ]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for outcome in pool.map(lambda cell: run_cell(*cell), cells):
            print(outcome, flush=True)


if __name__ == "__main__":
    main()
