"""Which search plans best with the same actor and critics: imagined return for each.

    python benchmarks/paper/searches.py --tasks acrobot --seeds 20 21
    python benchmarks/paper/searches.py --only-write       # the table of what there is

Trains actor and critics in the fitted models of the agents in results/agents, by the task's default
settings. Plans of several searches then play the same imagined episodes with them. No real step is
taken and no real episode played: a search is chosen in imagination alone. Writes
results/searches/{task}-seed{seed}.json and README.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from measures import paired_difference
from phihp_torchrl import load_config
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import origin_text
from phihp_torchrl.trainers import PolicyTrainer, read_run_config
from studies import study, train

RESULTS = Path("results/searches")
EPISODES = 32
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
    trained = train(task, seed, [], PolicyTrainer)
    returns, seconds = {}, {}
    for name, changes in SEARCHES.items():
        search = read_run_config(load_config(task, overrides=[*PRESET, *changes])).planner
        start = time.process_time()
        returns[name] = trained.plan(EPISODES, search)
        seconds[name] = time.process_time() - start
    return {
        "returns": returns,
        "seconds": seconds,
    }


def page(runs: Sequence[dict[str, Any]]) -> str:
    """A row for each task, seed and search."""
    rows = []
    for run in runs:
        usual = torch.tensor(run["returns"]["preset"])
        for name, found in run["returns"].items():
            gain = paired_difference(torch.tensor(found), usual)
            cost = run["seconds"][name] / run["seconds"]["preset"]
            rows.append(
                [
                    f"{run['task']}, {run['seed']}",
                    name,
                    f"{sum(found) / len(found):.1f}",
                    f"{gain.mean:+.2f} ± {gain.standard_error:.2f}",
                    f"{cost:.2f}",
                ]
            )
    header = ["task, seed", "search", "imagined return", "gain ± s.e.", "CPU time, of preset's"]
    origins = "; ".join(sorted({origin_text(run["origin"]) for run in runs}))
    said = "; ".join(
        f"{name}: `{' '.join(changes)}`" for name, changes in SEARCHES.items() if changes
    )
    return (
        "# Searches\n\nMade by `python benchmarks/paper/searches.py`. Do not edit. Imagined "
        f"returns of plans in {EPISODES} paired episodes, with the actor and the critics of one "
        "training by the task's default settings. The error is over episodes. CPU time is that of "
        "planning for all episodes at once."
        f"\n\n{markdown_table(header, rows)}\n\n{origins}.\n\nSearches, as changes of "
        f"`{' '.join(PRESET)}`: {said}.\n"
    )


if __name__ == "__main__":
    study(__doc__.splitlines()[0], RESULTS, measure, page)
