"""Learned controllers beside controllers by hand in the same learned model, on the six tasks.

    python benchmarks/paper/baselines.py

Plays the agents of results/agents with their planner and with their actor, and the baselines that
apply, built in each agent's own model, in 50 episodes of evaluation. Writes results/baselines/:
a table, and everything as JSON. What is there already is not measured again.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl.deployment import load_agent
from phihp_torchrl.evaluation import (
    controllers_table,
    evaluate,
    evaluation_seed,
    measure_latency,
    play_baselines,
)
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.worlds import SimulatedWorld

RESULTS = Path("results/baselines")
TASKS = ("pendulum", "pendulum-swingup", "cartpole", "cartpole-swingup", "acrobot",
         "acrobot-swingup")  # fmt: skip
_CALLS = 100


def measure(path: Path, names: str | list[str], episodes: int) -> dict[str, dict[str, Any]]:
    """What evaluations say of an agent's planner and actor and of its baselines, by name."""
    agent = load_agent(path)
    world, seed = SimulatedWorld(agent.task), evaluation_seed(0)
    results = {}
    for name, acting in (("planner", agent), ("actor", agent.actor_alone())):
        played = evaluate(acting, agent.task, episodes=episodes, seed=seed, world=world)
        latency = measure_latency(acting, agent.task, calls=_CALLS, seed=seed)
        results[name] = {**played.summary(), "returns": played.returns.tolist()}
        results[name] |= latency.summary()
    beside = play_baselines(
        agent, world, names, episodes=episodes, seed=seed, latency_actions=_CALLS
    )
    return {**results, **beside}


def write(entries: dict[str, Any], out: Path) -> None:
    """The results as JSON and as a page of tables."""
    text = ["# Learned controllers beside controllers by hand\n"]
    text.append(
        "Made by `python benchmarks/paper/baselines.py` from the agents in `results/agents/`; the "
        "baselines know the agent's learned model, not the truth. Returns are means over the same "
        "episodes with their standard errors (of one trained agent each), ms the mean time of one "
        "action.\n"
    )
    for task, entry in entries.items():
        text += [controllers_table(task, entry["results"]), f"Made at {entry['origin']}.\n"]
    (out / "README.md").write_text("\n".join(text))
    (out / "baselines.json").write_text(json.dumps(entries, indent=1) + "\n")


def main() -> None:
    """Measure what has not been measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=Path, default=Path("results/agents"))
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--baselines", nargs="+", help="names; by default the quick ones")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "baselines.json"
    entries = json.loads(path.read_text()) if path.is_file() else {}
    for task in arguments.tasks:
        if task in entries:
            continue
        found = measure(arguments.agents / task, arguments.baselines or "auto", arguments.episodes)
        entries[task] = {"results": found, "origin": origin_text(describe_origin(seed=0))}
        write(entries, arguments.out)
        print(controllers_table(task, found), flush=True)


if __name__ == "__main__":
    main()
