"""What fits from other first weights are worth, with a tenth of the samples.

    python benchmarks/paper/restarts.py --tasks cartpole-swingup --seeds 20 21 22

Takes the real steps of the model phase, with a tenth of those of the default preset, and fits the
last model once and with `model.restarts`. Both models then predict, from states of real episodes of
the shipped agent of the task, what random actions do; the error is the mean of squares in units of
one-step changes. It is no part of training, and decides nothing. Writes results/restarts/.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from measures import DEFAULT_SAMPLES, mean_of_seeds
from phihp_torchrl import load_agent, load_config
from phihp_torchrl.evaluation import TARGETS, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import ModelTrainer, play, read_run_config
from phihp_torchrl.worlds import SimulatedWorld

AGENTS, RESULTS = Path("results/agents"), Path("results/restarts")
# Development episodes, and of their states every fifth.
FIRST, EPISODES, STRIDE = 500_000, 4, 5


def visited(task: str) -> tuple[Tensor, Tensor, Tensor]:
    """States of real episodes of an agent and its actor, random actions, and what follows."""
    agent = load_agent(AGENTS / task, planner=True)
    truth, generator = SimulatedWorld(agent.task).model(), torch.Generator().manual_seed(FIRST)
    assert truth is not None  # a simulated world has one
    starts = agent.task.sample_start([EPISODES], generator)
    players = (agent.actor_alone(), agent)
    states = torch.cat(
        [play(each, truth, starts).states[:-1:STRIDE].flatten(0, 1) for each in players]
    )
    unit = 2.0 * torch.rand(len(states), agent.task.action_dim, generator=generator) - 1.0
    actions = agent.task.bounds.from_unit(unit)
    return states, actions, truth.transition(states, actions)[0]


def fitted(task: str, seed: int, restarts: int) -> ModelTrainer:
    """The model phase of a run with a tenth of the samples."""
    steps = DEFAULT_SAMPLES[task] // 10
    lines = [f"seed={seed}", f"model.real_steps={steps}", f"model.restarts={restarts}"]
    torch.manual_seed(seed)
    section = read_run_config(load_config(task, overrides=lines)).section("model")
    trainer = ModelTrainer(SimulatedWorld(task).task, section, seed=seed)
    while not trainer.done:
        trainer.advance()
    return trainer


@torch.no_grad()
def error(trainer: ModelTrainer, state: Tensor, action: Tensor, following: Tensor) -> float:
    """Mean square of the error of one step, in units of one-step changes."""
    off = trainer.task.difference(following, trainer.dynamics.step(state, action))
    return (off / trainer.loss.error_scale).square().sum(-1).mean().item()


def measure(task: str, seed: int, restarts: int, states: tuple[Tensor, ...]) -> dict[str, Any]:
    """The errors of one seed, without restarts and with them."""
    once, best = (error(fitted(task, seed, count), *states) for count in (0, restarts))
    found = {"task": task, "seed": seed, "restarts": restarts, "once": once, "best": best}
    return found | {"origin": describe_origin(seed)}


def kept_rows(results: Path) -> list[dict[str, Any]]:
    """The rows of earlier measurements."""
    path = results / "restarts.json"
    content = json.loads(path.read_text()) if path.is_file() else {"rows": []}
    older = {"origin": content["origin"]} if "origin" in content else {}
    return [older | row for row in content["rows"]]


def with_row(rows: Sequence[dict[str, Any]], row: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows by task and seed, with this one in the place of an earlier one of the same."""
    found = {(each["task"], each["seed"]): each for each in (*rows, row)}
    return [found[key] for key in sorted(found)]


def ratio(rows: list[dict[str, Any]]) -> tuple[float, float, float]:
    """Geometric mean over seeds of the errors' ratios, and its 95 % interval (Student's t)."""
    found = mean_of_seeds([math.log(row["best"] / row["once"]) for row in rows])
    assert found is not None  # of rows that there are
    return math.exp(found.mean), math.exp(found.low), math.exp(found.high)


def write_tables(measured: Sequence[dict[str, Any]], results: Path) -> None:
    """Write what was measured, and the table of it."""
    results.mkdir(parents=True, exist_ok=True)
    content = json.dumps({"rows": measured}, indent=1)
    (results / "restarts.json").write_text(content + "\n")
    rows = []
    for task in sorted({row["task"] for row in measured}):
        ours = [row for row in measured if row["task"] == task]
        mean, low, high = ratio(ours)
        once, best = (
            math.exp(sum(math.log(row[name]) for row in ours) / len(ours))
            for name in ("once", "best")
        )
        seeds = f"{ours[0]['seed']} to {ours[-1]['seed']}"
        cells = [task, str(DEFAULT_SAMPLES[task] // 10), seeds, f"{once:.2g}", f"{best:.2g}"]
        rows.append([*cells, f"{mean:.2f} ({low:.2f} to {high:.2f})"])
    header = ["task", "real steps", "training seeds", "one fit", "best of restarts", "ratio"]
    (results / "README.md").write_text(
        "# Fits from other first weights\n\nMade by `python benchmarks/paper/restarts.py`. Do not "
        "edit. Mean squares of one-step errors in units of one-step changes, at states of the "
        "shipped agent's real episodes and under random actions; geometric means over seeds, and "
        "of their ratios with the 95 % interval. Restarts: "
        f"{', '.join(sorted({str(row['restarts']) for row in measured}))}.\n\n"
        + markdown_table(header, rows)
        + f"\n{'; '.join(sorted({origin_text(row['origin']) for row in measured}))}.\n"
    )


def main() -> None:
    """Measure, and write after each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=sorted(TARGETS), default=["cartpole-swingup"])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(20, 30)))
    parser.add_argument("--restarts", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = kept_rows(arguments.results)
    for task in arguments.tasks:
        states = visited(task)
        for seed in arguments.seeds:
            row = measure(task, seed, arguments.restarts, states)
            rows = with_row(rows, row)
            write_tables(rows, arguments.results)
            print(row, flush=True)


if __name__ == "__main__":
    main()
