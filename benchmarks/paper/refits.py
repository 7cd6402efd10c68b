"""What the last fit of the critics is worth to the plan, and what it costs.

    python benchmarks/paper/refits.py --tasks pendulum-swingup --seeds 20 21
    python benchmarks/paper/refits.py --only-write       # the table of what there is

Trains actor and critics in the fitted models of the agents in results/agents, by the task's default
settings but for that fit, which some leave out. The plan of the default preset then plays paired
imagined episodes with the critics as they were before their last fit to returns, and with the
fitted ones. No real step is taken and no real episode played. Writes
results/refits/{task}-seed{seed}.json and README.md.
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

AGENTS, RESULTS = Path("results/agents"), Path("results/refits")
EPISODES = 24
FIT = "policy.refit.interval=2000"
"""A fit at the end, also where the task's settings leave it out; any number above 0 says so."""


class LastFit(PolicyTrainer):
    """Keeps the critics as they were before each fit, and the seconds that it takes."""

    unfitted: Any = None
    seconds_of_fits = 0.0

    def _refit_critics(self) -> dict[str, float]:
        self.unfitted, start = self.best_qvalue(), time.process_time()
        found = super()._refit_critics()
        self.seconds_of_fits += time.process_time() - start
        return found


def measure(task: str, seed: int) -> dict[str, Any]:
    """Train, and play both plans."""
    agent = load_agent(AGENTS / task, packaged=False)
    config = read_run_config(load_config(task, overrides=[FIT]))
    torch.manual_seed(seed)
    assert agent.dynamics is not None  # of an agent that was trained in it
    start = time.process_time()
    trainer = LastFit(agent.task, agent.dynamics, config.section("policy"), seed=seed)
    while not trainer.done:
        trainer.advance()
    seconds = time.process_time() - start
    model = TaskWorldModel(agent.task, agent.dynamics)
    states = agent.task.sample_start([EPISODES], torch.Generator().manual_seed(seed))
    returns = {}
    for name, critics in (("before", trainer.unfitted), ("fitted", trainer.best_qvalue())):
        parts = {"dynamics": agent.dynamics, "actor": trainer.best_actor(), "qvalue": critics}
        plan = Agent(agent.task, **parts, planner_config=config.planner)
        returns[name] = play(plan, model, states, seed=seed).total.tolist()
    return {
        "task": task,
        "seed": seed,
        "returns": returns,
        "seconds_of_fits": trainer.seconds_of_fits,
        "seconds": seconds,
        "origin": describe_origin(seed),
    }


def write_table(results: Path) -> None:
    """A row for each task and seed."""
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    rows = []
    for task in TARGETS:
        for run in (run for run in runs if run["task"] == task):
            before, fitted = run["returns"]["before"], run["returns"]["fitted"]
            gain = paired_difference(torch.tensor(fitted), torch.tensor(before))
            share = run["seconds_of_fits"] / run["seconds"]
            rows.append(
                [
                    f"{task}, {run['seed']}",
                    f"{sum(before) / len(before):.1f}",
                    f"{sum(fitted) / len(fitted):.1f}",
                    f"{gain.mean:+.2f} ± {gain.standard_error:.2f}",
                    f"{run['seconds_of_fits']:.1f}",
                    f"{share:.0%}",
                ]
            )
    header = ["task, seed", "before the fit", "after", "gain ± s.e.", "CPU s", "share of training"]
    origins = "; ".join(sorted({origin_text(run["origin"]) for run in runs}))
    (results / "README.md").write_text(
        "# The last fit of the critics\n\nMade by `python benchmarks/paper/refits.py`. Do not edit."
        f" Imagined returns of the default preset's plan in {EPISODES} paired episodes, with the "
        "critics before and after they are fitted to returns, once at the end of training, also "
        f"where the settings leave that out (`{FIT}`). The error is over episodes, of one training "
        "each."
        f"\n\n{markdown_table(header, rows)}\n\n{origins}.\n"
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
            print(path.stem, found["seconds_of_fits"], flush=True)
    write_table(options.results)


if __name__ == "__main__":
    main()
