"""What a delay, a lag and noisy sensors cost, of which nobody is told.

    python benchmarks/paper/plants.py --seeds 101 102

Learns tasks from defaults in simulated worlds whose motors are late or slow or whose sensors are
noisy, beside the same world without. The task does not know of it: phase 1 finds dead time and lag
by itself. The share of the return that is lost is counted from the floor that doing nothing earns
in the world, for returns have no zero of their own. Writes results/plants/ after every run.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from measures import agent_in
from phihp_torchrl import load_config, run
from phihp_torchrl.evaluation import evaluate, evaluation_seed, markdown_table
from phihp_torchrl.origin import commit_text, machine_text
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import RunDirectory, read_run_config

RESULTS, RUNS = Path("results/plants"), Path("outputs/plants")
TASKS = ("pendulum-swingup", "cartpole-swingup")
EPISODES = 20
AS_IT_IS = "as it is"
PLANTS: dict[str, tuple[str, ...]] = {
    AS_IT_IS: (),
    "delay of one step": ("world.actuator.delay_steps=1",),
    "delay of two steps": ("world.actuator.delay_steps=2",),
    "lag of 40 ms": ("world.actuator.lag=0.04",),
    "noise": (),
}
"""Changes of the world by name; noise is that of the task below."""
NOISE = {
    "pendulum-swingup": ("world.noise.theta=0.01", "world.noise.theta_dot=0.05"),
    "cartpole-swingup": (
        "world.noise.x=0.005",
        "world.noise.x_dot=0.02",
        "world.noise.theta=0.01",
        "world.noise.theta_dot=0.05",
    ),
}
"""Standard deviations: half a degree, an encoder's millimetres, and speeds from their slopes."""


def changes(task: str, plant: str) -> tuple[str, ...]:
    """The settings of the world."""
    return NOISE[task] if plant == "noise" else PLANTS[plant]


def still(tensordict: TensorDict) -> TensorDict:
    """Do nothing."""
    shape = (*tensordict.batch_size, 1)
    return tensordict.set("action", torch.zeros(shape))


def floor_of(task: str) -> float:
    """What doing nothing earns in the world as it is."""
    played = evaluate(still, get_task(task), episodes=EPISODES, seed=evaluation_seed(0))
    return float(played.returns.mean())


def learn_in(task: str, plant: str, seed: int, path: Path) -> dict[str, Any] | None:
    """A run, or the rest of it; ``None`` if a signal stopped it."""
    lines = [f"seed={seed}", f"evaluate.episodes={EPISODES}", "evaluate.latency_actions=0",
             "evaluate.video=false", "evaluate.baselines=none", "progress=false",
             *changes(task, plant)]  # fmt: skip
    config = read_run_config(load_config(task, overrides=lines))
    made = run(config, path, resume=RunDirectory(path).config.is_file())
    if not made.finished:
        return None
    metadata = json.loads((made.path / "metadata.json").read_text())
    played = json.loads((made.path / "evaluation.json").read_text())
    return {
        "task": task,
        "plant": plant,
        "seed": seed,
        "settings": lines,
        "real_steps": metadata["real_steps"],
        "returns": {name: found["returns"] for name, found in played.items()},
        "chatter": {name: found.get("chatter") for name, found in played.items()},
        "floor": floor_of(task),
        "seconds": metadata["seconds"],
        "origin": metadata["sessions"][0],
    }


def agent_of(found: Mapping[str, Any]) -> float:
    """Mean return of the agent: its plans, or its actor where calibration let that act."""
    returns = found["returns"][agent_in(found["returns"])]
    return math.fsum(returns) / len(returns)


def lost(found: Mapping[str, Any], without: Mapping[str, Any]) -> float:
    """The share of the return above the floor that is lost, beside the same seed without."""
    best = agent_of(without)
    return (best - agent_of(found)) / (best - found["floor"])


def page(entries: Sequence[Mapping[str, Any]]) -> str:
    """The results as a page."""
    rows = []
    for found in entries:
        same = [e for e in entries if (e["task"], e["seed"]) == (found["task"], found["seed"])]
        without = [e for e in same if e["plant"] == AS_IT_IS]
        share = f"{100 * lost(found, without[0]):.1f}" if without else "–"
        acting = agent_in(found["returns"])
        chatter = found["chatter"][acting]
        rows.append([found["task"], found["plant"], str(found["seed"]), f"{agent_of(found):.1f}",
                     share, "–" if chatter is None else f"{chatter:.3f}", acting])  # fmt: skip
    header = ["task", "plant", "seed", "return", "lost %", "chatter", "acting"]
    noise = "; ".join(f"{task}: {', '.join(words)}" for task, words in NOISE.items())
    of_tasks = {e["task"]: e["floor"] for e in entries if e["plant"] == AS_IT_IS}
    floors = "; ".join(f"{task}: {floor:.1f}" for task, floor in of_tasks.items())
    commits = ", ".join(sorted({commit_text(e["origin"]) for e in entries}))
    machines = "; ".join(sorted({machine_text(e["origin"]) for e in entries}))
    return (
        "# What a delay, a lag and noise cost\n\n"
        "Made by `python benchmarks/paper/plants.py`. Do not edit. Default settings: the task is "
        "told nothing of what the world does to commands and to what sensors show. Returns are "
        f"means of {EPISODES} episodes in that world. *lost %* is the share of the return above "
        "the floor (what doing nothing earns) that is lost, beside the same training seed in the "
        "world as it is, whose episodes start elsewhere in the same box. "
        f"Noise is {noise}. Floors: {floors}.\n\n"
        f"{markdown_table(header, rows)}\n"
        f"Commits: {commits}. Machines: {machines}, shared with other work.\n"
    )


def write(results: Path) -> None:
    """README.md from all runs that there are."""
    entries = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    order = list(PLANTS)
    entries.sort(key=lambda e: (e["task"], e["seed"], order.index(e["plant"])))
    (results / "README.md").write_text(page(entries))


def main() -> None:
    """Run what is missing, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--plants", nargs="+", choices=PLANTS, default=list(PLANTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--runs", type=Path, default=RUNS, help="where runs and checkpoints are")
    arguments = parser.parse_args()
    arguments.results.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:
        for task in arguments.tasks:
            for plant in arguments.plants:
                name = f"{task}-{plant.replace(' ', '-')}-{seed}"
                file = arguments.results / f"{name}.json"
                if file.is_file():
                    continue
                found = learn_in(task, plant, seed, arguments.runs / name)
                if found is None:
                    parser.exit(1, f"{name}: stopped; give the command again.\n")
                file.write_text(json.dumps(found, indent=1) + "\n")
                write(arguments.results)


if __name__ == "__main__":
    main()
