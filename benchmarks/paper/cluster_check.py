"""Kill a node of a Ray cluster in the middle of a grid, and see that nothing is lost or done twice.

    python benchmarks/paper/cluster_check.py

Starts Ray's own test cluster, two nodes on this machine, and twelve small cells on it, of two tasks
and six seeds (``--seeds``); kills one node while a cell of its is under way; then runs the same
cells once more without Ray, and compares the two reports, times apart, byte by byte. Needs the
extra `cluster`; everything goes into outputs/cluster_check/. Exit code 1 if anything differs.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from measures import read_curve, write_curve
from report import ReportConfig, make_report

TASKS, SEEDS, SHARE = ("pendulum", "cartpole"), 6, 0.05

# The least that the phases can do; the tests of the commands take it too.
TINY = (
    "compile=false",
    "evaluate.baselines=none",
    "evaluate.episodes=2",
    "evaluate.latency_actions=3",
    "calibrate.enabled=false",
    "model.fit.steps=2",
    "model.integrator=semi_implicit_euler",
    "model.collect.planning_horizon=3",
    "model.collect.replan_every=2",
    "model.collect.num_candidates=8",
    "model.collect.top_k=2",
    "model.collect.optim_steps=1",
    "policy.batch_size=8",
    "policy.num_worlds=4",
    "policy.chunk_steps=2",
    "policy.updates_per_step=2",
    "policy.replay_capacity=200",
    "policy.random_steps=16",
    "policy.evaluation_interval=4",
    "policy.evaluation_episodes=2",
    "policy.evaluation_steps=20",
    "policy.td3.actor_hidden_sizes=[8]",
    "policy.td3.critic_hidden_sizes=[8]",
    "planner.planning_horizon=2",
    "planner.replan_every=2",
    "planner.optim_steps=1",
    "planner.num_candidates=8",
    "planner.num_policy_candidates=2",
    "planner.top_k=2",
)

# A few seconds a cell, in many units of work with a checkpoint after each.
SMALL = (
    *TINY,
    "checkpoint_interval=0",
    "evaluate.video=false",
    "model.steps_per_iteration=50",
    "policy.updates=160",
)


def grid_command(place: Path, launcher: str, seeds: int) -> list[str]:
    """The cells, with all they leave in ``place``."""
    overrides = ",".join(f'"{override}"' for override in SMALL)
    return [
        sys.executable,
        str(Path(__file__).with_name("run_grid.py")),
        f"launcher={launcher}",
        f"task={','.join(TASKS)}",
        f"seed=range({seeds})",
        f"share={SHARE}",
        f"runs={place / 'runs'}",
        f"results={place / 'results'}",
        f"overrides=[{overrides}]",
        f"hydra.sweep.dir={place / 'multirun'}",
        "refresh=0.5",
        "allow_dirty=true",  # nothing of it is kept
    ]


def run_with_a_kill(place: Path, timeout: float, seeds: int) -> str:
    """Run the cells on two nodes and kill one; returns the cells it was at."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    environment = {**os.environ, "RAY_ADDRESS": cluster.address}
    try:
        with subprocess.Popen(grid_command(place, "ray", seeds), env=environment) as process:
            under_way = wait(lambda: middle(place, seeds), process, timeout)
            cluster.remove_node(second, allow_graceful=False)
            print(f"killed a node; done {len(done(place))}, under way {under_way}", flush=True)
            process.wait(timeout)
    finally:
        cluster.shutdown()
    return under_way


def wait(what: Callable[[], str], process: subprocess.Popen, timeout: float) -> str:
    """The first answer that is not empty, while the process runs."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and process.poll() is None:
        if answer := what():
            return answer
        time.sleep(0.02)
    process.kill()
    raise TimeoutError(f"the grid did not get to its middle within {timeout:.0f} s")


def done(place: Path) -> list[str]:
    """Names of the finished cells."""
    return sorted(path.parent.name for path in (place / "results").glob("*/evaluation.json"))


def middle(place: Path, seeds: int) -> str:
    """The two cells under way, once a third of all are done; else an empty text."""
    finished = done(place)
    if len(finished) < len(TASKS) * seeds // 3:
        return ""
    halves = [
        path.parent.name
        for path in (place / "runs").glob("*/metrics.csv")
        if path.parent.name not in finished and 5 < len(path.read_text().splitlines()) < 30
    ]
    return ", ".join(halves) if len(halves) == 2 else ""


def twice_done(place: Path) -> list[str]:
    """What was done twice: cells that finished twice, units of work in a row that came twice."""
    found = []
    for log in sorted((place / "runs").glob("*.log")):
        words = Counter(line.rsplit(" ", 1)[-1] for line in log.read_text().splitlines())
        if words["finished"] != 1:
            found.append(f"{log.stem} finished {words['finished']} times")
    for path in sorted((place / "results").glob("*/metrics.csv")):
        with path.open(newline="") as file:
            units = [int(row["unit"]) for row in csv.DictReader(file)]
        if units != list(range(len(units))):
            found.append(f"{path.parent.name} has units {units}")
    return found


def interrupted(place: Path) -> list[str]:
    """Cells that were begun more than once."""
    logs = {log.stem: log.read_text() for log in sorted((place / "runs").glob("*.log"))}
    return [name for name, text in logs.items() if " resumed" in text or text.count("started") > 1]


def report_files(place: Path, compared: Path) -> dict[str, bytes]:
    """The report on a place's runs, with all times set to zero, by file."""
    shutil.rmtree(compared, ignore_errors=True)
    shutil.copytree(place / "results", compared / "results")
    for evaluation in (compared / "results").glob("*/evaluation.json"):
        forget_times(evaluation.parent)
    make_report(
        ReportConfig(
            runs=str(compared / "results"),
            sensitivity=str(compared / "none"),
            out=str(compared / "report"),
            reps=50,
            overview=str(compared / "overview.md"),
        )
    )
    paths = sorted(path for path in compared.rglob("*") if path.is_file())
    return {str(path.relative_to(compared)): path.read_bytes()
            for path in paths if "results" not in path.relative_to(compared).parts}  # fmt: skip


def forget_times(folder: Path) -> None:
    """Set latency and seconds to zero: they are never the same twice."""
    evaluation = json.loads((folder / "evaluation.json").read_text())
    for part in evaluation.values():
        part.update({key: 0.0 for key in part if key.startswith("latency") or key == "seconds"})
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    metadata = json.loads((folder / "metadata.json").read_text())
    metadata["seconds"] = dict.fromkeys(metadata["seconds"], 0.0)
    (folder / "metadata.json").write_text(json.dumps(metadata))
    curve = [replace(point, seconds=0.0) for point in read_curve(folder / "curve.csv")]
    write_curve(folder / "curve.csv", curve)


def check(place: Path, timeout: float = 900.0, seeds: int = SEEDS) -> list[str]:
    """Everything that went wrong, a sentence each."""
    shutil.rmtree(place, ignore_errors=True)
    with_kill, without = place / "with_kill", place / "without"
    run_with_a_kill(with_kill, timeout, seeds)
    subprocess.run(grid_command(without, "basic", seeds), check=False, timeout=timeout)
    cells = len(TASKS) * seeds
    wrong = [
        f"{where.name}: {len(done(where))} of {cells} cells are done"
        for where in (with_kill, without)
        if len(done(where)) != cells
    ]
    wrong += twice_done(with_kill)
    again = interrupted(with_kill)
    print(f"gone on with after the kill: {', '.join(again) or 'none'}")
    if not again:
        wrong.append("the kill met no cell")
    ours, theirs = (report_files(where, place / "compared") for where in (with_kill, without))
    print(f"reports: {len(ours)} files with the kill, {len(theirs)} without")
    wrong += [f"{name} differs" for name in sorted({*ours, *theirs})
              if ours.get(name) != theirs.get(name)]  # fmt: skip
    return wrong


def main() -> None:
    """Check and say how it went."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="outputs/cluster_check", help="directory for all of it")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="cells of each task")
    given = parser.parse_args()
    wrong = check(Path(given.out).absolute(), seeds=given.seeds)
    for sentence in wrong:
        print(f"wrong: {sentence}")
    if wrong:
        sys.exit(1)
    print(
        f"all {len(TASKS) * given.seeds} cells done, none twice; the report is as without the kill"
    )


if __name__ == "__main__":
    main()
