"""Policies trained with a limit of speed at several prices, and what they violate and earn.

    python benchmarks/paper/constraints.py

A pendulum on its way up passes the bottom fast, the faster the less torque is left for the rest.
Here its speed is to stay within 5 rad/s. Actors are trained in the model of results/agents/pendulum
with the constraint at each price (``constraints.theta_dot.price=...``; 0 only reports it), all with
the same seed and budget, and play the same episodes of evaluation in the world, which knows of no
price. Writes results/constraints/; what is there already is not trained again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl import Agent, evaluate, load_agent, load_config
from phihp_torchrl.evaluation import EVALUATION_SEED, markdown_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.trainers import PolicyTrainer, read_run_config, task_of

AGENTS, RESULTS = Path("results/agents"), Path("results/constraints")
TASK, STATE, LIMIT = "pendulum", "theta_dot", 5.0
PRICES = (0.0, 0.3, 3.0)


def settings(price: float, seed: int, updates: int) -> list[str]:
    """The settings of a run, as on a command line of ``phihp train``."""
    limits = {"low": -LIMIT, "high": LIMIT, "price": price}
    words = [f"constraints.{STATE}.{name}={value}" for name, value in limits.items()]
    return [
        *words,
        f"seed={seed}",
        f"policy.updates={updates}",
        f"policy.evaluation_interval={max(2, updates // 4)}",
        "policy.refit.interval=0",
    ]


def train(lines: Sequence[str], seed: int) -> Agent:
    """The best actor of a run in the agent's model."""
    config = read_run_config(load_config(TASK, overrides=list(lines)))
    task = task_of(config)
    dynamics = load_agent(AGENTS / TASK, planner=False).dynamics
    assert dynamics is not None  # shipped agents have one
    torch.manual_seed(seed)
    trainer = PolicyTrainer(task, dynamics, config.section("policy"), seed=seed)
    while not trainer.done:
        trainer.advance()
    return Agent(task, actor=trainer.best_actor())


def measure(price: float, seed: int, updates: int, episodes: int) -> dict[str, Any]:
    """Train at a price, and play."""
    begun = time.perf_counter()
    lines = settings(price, seed, updates)
    agent = train(lines, seed)
    seconds = time.perf_counter() - begun
    played = evaluate(agent, agent.task, episodes=episodes, seed=EVALUATION_SEED)
    return {
        "price": price,
        "seed": seed,
        "updates": updates,
        "settings": lines,
        "seconds": seconds,
        "episodes": episodes,
        "measured": {**played.summary(), "standard_error": played.standard_error},
        "origin": describe_origin(seed),
    }


def write(results: Path) -> str:
    """Write the table of all results so far; returns it."""
    every = [json.loads(path.read_text()) for path in results.glob("*.json")]
    every.sort(key=lambda each: (each["seed"], each["price"]))
    head = ["seed", "price", "return", "s.e.", "steps beyond", "episodes beyond",
            "farthest beyond in rad/s"]  # fmt: skip
    rows = []
    for each in every:
        m, name = each["measured"], f"violations/{STATE}"
        shares = [f"{100 * m[f'{name}/{key}']:.1f} %" for key in ("steps_share", "episodes_share")]
        means = [f"{m['return_mean']:.1f}", f"{m['standard_error']:.1f}"]
        rows.append(
            [
                str(each["seed"]),
                f"{each['price']:g}",
                *means,
                *shares,
                f"{m[f'{name}/largest']:.2f}",
            ]
        )
    table = markdown_table(head, rows)
    commits = sorted({commit_text(each["origin"]) for each in every})
    machines = sorted({machine_text(each["origin"]) for each in every})
    counts = {(each["updates"], each["episodes"]) for each in every}
    budgets = "; ".join(f"{u} updates, {e} episodes of evaluation" for u, e in sorted(counts))
    (results / "README.md").write_text(
        "# A limit of speed, at several prices\n\n"
        f"Made by `python benchmarks/paper/constraints.py`. Do not edit. Actors for `{TASK}`, "
        f"trained in the model of `{AGENTS / TASK}` with |{STATE}| within {LIMIT:g} rad/s at a "
        "price for each rad/s beyond it in a step; 0 only reports it. They play the same episodes "
        f"in the world ({budgets}). Returns are the world's, without prices.\n\n{table}\n"
        f"Commits: {', '.join(commits)}. Machines: {', '.join(machines)}, shared with other work.\n"
    )
    return table


def main(words: Sequence[str] | None = None) -> None:
    """Train and play what the words name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--prices", type=float, nargs="+", default=list(PRICES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[100])
    parser.add_argument("--updates", type=int, default=4000)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    arguments.results.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:
        for price in arguments.prices:
            path = arguments.results / f"{TASK}-price{price:g}-seed{seed}.json"
            if not path.exists():
                found = measure(price, seed, arguments.updates, arguments.episodes)
                path.write_text(json.dumps(found, indent=1) + "\n")
                print(write(arguments.results), flush=True)
    write(arguments.results)


if __name__ == "__main__":
    main()
