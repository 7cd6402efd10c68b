"""Whole runs from defaults in worlds that others made, beside the published scores of others.

    python benchmarks/paper/worlds.py --seeds 100 101 102

Needs the extra ``dmcontrol``. A run has the default settings; it is told the system, its stops and
the simulator's integrator, as in ``other_worlds``, and takes at most as many steps of the
environment as ``ENTRIES`` says. It is judged in the world itself, in episodes that no training
uses. Writes results/worlds/<task>-<seed>.json after every run, and a README.md and a picture
beside them. A run that was stopped goes on from its last checkpoint when the command is given
again, and one that is finished is not repeated. The scores of others are those of
results/worlds/published.csv, which ``published_scores.py`` makes.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measures import last_metrics
from other_worlds import WORLDS
from phihp_torchrl import load_config, run
from phihp_torchrl.config import kind_mapping
from phihp_torchrl.tasks import list_tasks, register_task
from phihp_torchrl.trainers import RunDirectory, read_run_config
from phihp_torchrl.worlds import EnvWorld, GivenConfig
from report.write import put_between
from world_scores import brief, write_report

RESULTS, RUNS = Path("results/worlds"), Path("outputs/worlds")
START, END = "<!-- worlds:start -->", "<!-- worlds:end -->"
EPISODES = 20


@dataclass(frozen=True)
class Entry:
    """A task that is learned.

    Args:
        world: name of the world in ``other_worlds``.
        environment_steps: most steps of the environment; ``None`` for the default's transitions.
        target: return that the run should reach.
    """

    world: str
    environment_steps: int | None
    target: float


ENTRIES = {
    "pendulum-swingup": Entry("dm_control pendulum", 2000, 800.0),
    "cartpole-swingup": Entry("dm_control cartpole", 4000, 850.0),
    "cartpole-swingup-sparse": Entry("dm_control cartpole swingup sparse", 4000, 700.0),
    "cartpole-balance": Entry("dm_control cartpole balance", 2000, 950.0),
    "cartpole-balance-sparse": Entry("dm_control cartpole balance sparse", 2000, 950.0),
    "mountain-car": Entry("gymnasium MountainCarContinuous-v0", 4000, 90.0),
    "mountain-car-as-it-is": Entry("gymnasium MountainCarContinuous-v0 as it is", 4000, 90.0),
    "pendulum-v1": Entry("gymnasium Pendulum-v1", 2000, -200.0),
    "acrobot-swingup": Entry("dm_control acrobot", None, 400.0),
}


def settings(entry: Entry, seed: int, changes: Sequence[str] = ()) -> list[str]:
    """What a run is told, as on a command line of ``phihp train``."""
    world = WORLDS[entry.world]
    lines = [f"model.{key}={value}" for key, value in world.model.items()]
    if entry.environment_steps is not None:
        lines.append(f"model.real_steps={entry.environment_steps // world.repeat}")
    lines += [f"evaluate.episodes={EPISODES}", "evaluate.latency_actions=0", "evaluate.video=false"]
    return [f"seed={seed}", *lines, "progress=false", *changes]


def train(name: str, seed: int, path: Path, changes: Sequence[str] = ()) -> dict[str, Any] | None:
    """A run, or the rest of it; ``None`` if a signal stopped it."""
    entry = ENTRIES[name]
    world, lines = WORLDS[entry.world], settings(entry, seed, changes)
    if world.task.name not in list_tasks():
        register_task(world.task)
    loaded = load_config(world.task.name, overrides=lines)
    config = read_run_config({**loaded, "world": kind_mapping(GivenConfig())})
    begun = RunDirectory(path).config.is_file()
    made = run(config, path, resume=begun, world=EnvWorld(world.task, world.make_env, copies=True))
    return result(name, seed, lines, made.path) if made.finished else None


_LOGGED = ("model/held_out_error", "policy/best_imagined_return", "policy/at_floor")


def result(name: str, seed: int, lines: Sequence[str], path: Path) -> dict[str, Any]:
    """What the files of a finished run say."""
    entry = ENTRIES[name]
    metadata = json.loads((path / "metadata.json").read_text())
    played = json.loads((path / "evaluation.json").read_text())
    with (path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {
        "task": name,
        "world": entry.world,
        "seed": seed,
        "settings": list(lines),
        "transitions": metadata["real_steps"],
        "environment_steps": metadata["real_steps"] * WORLDS[entry.world].repeat,
        "returns": {who: found["returns"] for who, found in played.items()},
        "target": entry.target,
        "policy": metadata.get("policy", {}),
        "metrics": last_metrics(rows, _LOGGED),
        "seconds": metadata["seconds"],
        "origin": metadata["sessions"][0],
    }


def main() -> None:
    """Run what is missing, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=ENTRIES, default=list(ENTRIES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[100])
    parser.add_argument("--eager", action="store_true", help="without the compiler, on a busy CPU")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--runs", type=Path, default=RUNS, help="where runs and checkpoints are")
    arguments = parser.parse_args()
    arguments.results.mkdir(parents=True, exist_ok=True)
    changes = ["compile=false"] if arguments.eager else []
    for seed in arguments.seeds:  # every seed is whole before the next begins
        for name in arguments.tasks:
            file = arguments.results / f"{name}-{seed}.json"
            if file.is_file():
                continue
            found = train(name, seed, arguments.runs / f"{name}-{seed}", changes)
            if found is None:
                parser.exit(1, f"{name}, seed {seed}: stopped; give the command again.\n")
            file.write_text(json.dumps(found, indent=1) + "\n")
            write_report(arguments.results, list(ENTRIES))
    write_report(arguments.results, list(ENTRIES))
    if arguments.results == RESULTS:  # and not others' runs
        put_between(Path("README.md"), START, END, brief(RESULTS, list(ENTRIES)))


if __name__ == "__main__":
    main()
