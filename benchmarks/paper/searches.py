"""Which search plans best with the same actor and critics: imagined return for each.

    python benchmarks/paper/searches.py --tasks acrobot --seeds 20 21
    python benchmarks/paper/searches.py --only-write       # the table of what there is

Trains actor and critics in the fitted models of the agents in results/agents, by the task's default
settings. Plans of several searches then play the same imagined episodes with them. No real step is
taken and no real episode played: a search is chosen in imagination alone. Writes
results/searches/{task}-seed{seed}.json and README.md.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from measures import paired_difference
from phihp_torchrl import Agent, load_agent, load_config
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import TARGETS, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import PolicyTrainer, play, read_run_config

AGENTS, RESULTS = Path("results/agents"), Path("results/searches")
EPISODES = 48
PRESET = [
    "planner.planning_horizon=50",
    "planner.optim_steps=1",
    "planner.num_candidates=64",
    "planner.top_k=6",
    "planner.noise_beta=2.0",
    "planner.keep_incumbent=false",
]
"""What the default preset says of every task, whatever a task says of itself."""
_KEPT = "planner.keep_incumbent=true"
_SHORTER = [_KEPT, "planner.planning_horizon=30", "planner.optim_steps=2"]
SEARCHES = {
    "preset": [],
    "kept": [_KEPT],
    "kept, smoother": [_KEPT, "planner.noise_beta=3.0"],
    "kept, 128 candidates": [_KEPT, "planner.num_candidates=128"],
    "kept, 128 candidates, smoother": [
        _KEPT,
        "planner.num_candidates=128",
        "planner.noise_beta=3.0",
    ],
    "kept, 2 x 30": _SHORTER,
    "kept, 2 x 30, 3 elites": [*_SHORTER, "planner.top_k=3"],
}
"""Changes of the preset's search. A kept plan competes with the next ones (*keep_incumbent*)."""


def measure(task: str, seed: int) -> dict[str, Any]:
    """Train once, and play the plans of all searches."""
    agent = load_agent(AGENTS / task, packaged=False)
    config = read_run_config(load_config(task))
    torch.manual_seed(seed)
    assert agent.dynamics is not None  # of an agent that was trained in it
    trainer = PolicyTrainer(agent.task, agent.dynamics, config.section("policy"), seed=seed)
    while not trainer.done:
        trainer.advance()
    parts = {
        "dynamics": agent.dynamics,
        "actor": trainer.best_actor(),
        "qvalue": trainer.best_qvalue(),
    }
    model = TaskWorldModel(agent.task, agent.dynamics)
    states = agent.task.sample_start([EPISODES], torch.Generator().manual_seed(seed))
    returns, seconds = {}, {}
    for name, changes in SEARCHES.items():
        search = read_run_config(load_config(task, overrides=[*PRESET, *changes])).planner
        plan, start = Agent(agent.task, **parts, planner_config=search), time.process_time()
        returns[name] = play(plan, model, states, seed=seed).total.tolist()
        seconds[name] = time.process_time() - start
    return {
        "task": task,
        "seed": seed,
        "returns": returns,
        "seconds": seconds,
        "origin": describe_origin(seed),
    }


def write_table(results: Path) -> None:
    """A row for each task, seed and search."""
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    rows = []
    for task in TARGETS:
        for run in (run for run in runs if run["task"] == task):
            usual = torch.tensor(run["returns"]["preset"])
            for name, found in run["returns"].items():
                gain = paired_difference(torch.tensor(found), usual)
                cost = run["seconds"][name] / run["seconds"]["preset"]
                rows.append(
                    [
                        f"{task}, {run['seed']}",
                        name,
                        f"{sum(found) / len(found):.1f}",
                        f"{gain.mean:+.2f} ± {gain.standard_error:.2f}",
                        f"{cost:.2f}",
                    ]
                )
    header = ["task, seed", "search", "imagined return", "gain ± s.e.", "CPU time, of preset's"]
    origins = "; ".join(sorted({origin_text(run["origin"]) for run in runs}))
    said = "; ".join(f"{name}: `{' '.join(changes)}`" for name, changes in SEARCHES.items())
    (results / "README.md").write_text(
        "# Searches\n\nMade by `python benchmarks/paper/searches.py`. Do not edit. Imagined "
        f"returns of plans in {EPISODES} paired episodes, with the actor and the critics of one "
        "training by the task's default settings. The error is over episodes. CPU time is that of "
        "planning for all episodes at once."
        f"\n\n{markdown_table(header, rows)}\n\n{origins}.\n\nSearches, as changes of "
        f"`{' '.join(PRESET)}`: {said}.\n"
    )


def main() -> None:
    """Measure what is missing, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[20, 21])
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--only-write", action="store_true")
    options = parser.parse_args()
    options.results.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    for seed in () if options.only_write else options.seeds:
        for task in options.tasks:
            path = options.results / f"{task}-seed{seed}.json"
            if path.is_file():
                continue
            found = measure(task, seed)
            path.write_text(json.dumps(found) + "\n")
            print(path.stem, flush=True)
    write_table(options.results)


if __name__ == "__main__":
    main()
