"""Learned controllers beside controllers by hand in the same learned model, on the six tasks.

    python benchmarks/paper/baselines.py

Plays the agents of results/agents with their planner and with their actor, and all registered
baselines that apply, built in each agent's own model, in 50 episodes of evaluation; those that plan
at each step, as iLQR and MPPI, in fewer (``--slow-episodes``), for iLQR needs minutes for each.
Writes results/baselines/: a table, and everything as JSON. What is there already, of an agent with
the same weights, is not measured again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl import Agent, ConfigError
from phihp_torchrl.baselines import BASELINES, make_baselines
from phihp_torchrl.deployment import load_agent
from phihp_torchrl.evaluation import (
    TARGETS,
    controllers_table,
    evaluate,
    evaluation_seed,
    measure_latency,
    play_baselines,
)
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.worlds import SimulatedWorld

RESULTS = Path("results/baselines")
LEARNED = ("planner", "actor")
"""The two ways in which an agent acts."""
_CALLS = 100


def applying(agent: Agent, names: Sequence[str]) -> list[str]:
    """Those of the baselines that apply to an agent's task in its model; says why others do not."""
    assert agent.dynamics is not None
    found = []
    for name in names:
        try:
            make_baselines(agent.task, agent.dynamics, [name])
        except ConfigError as error:
            print(f"{agent.task.name}: {error}", flush=True)
        else:
            found.append(name)
    return found


def measure(agent: Agent, name: str, episodes: int) -> dict[str, Any]:
    """What evaluations say of an agent's planner or actor, or of a baseline in its model."""
    world, seed = SimulatedWorld(agent.task), evaluation_seed(0)
    if name not in LEARNED:
        options: dict[str, Any] = {"episodes": episodes, "seed": seed, "latency_actions": _CALLS}
        return play_baselines(agent, world, [name], **options)[name]
    acting = agent if name == "planner" else agent.actor_alone()
    played = evaluate(acting, agent.task, episodes=episodes, seed=seed, world=world)
    latency = measure_latency(acting, agent.task, calls=_CALLS, seed=seed)
    return {**played.summary(), "returns": played.returns.tolist(), **latency.summary()}


def page(entries: dict[str, Any]) -> str:
    """A table for each task, and where it comes from."""
    text = ["# Learned controllers beside controllers by hand\n"]
    text.append(
        "Made by `python benchmarks/paper/baselines.py` from the agents in `results/agents/`; the "
        "baselines know the agent's learned model, not the truth. Returns are means over the same "
        "episodes, or over fewer where it is said, with their standard errors (of one trained "
        "agent each), ms the mean time of one action.\n"
    )
    for task, entry in entries.items():
        results = entry["results"]
        most = max(result["episodes"] for result in results.values())
        fewer = [
            f"{name} was played in {result['episodes']:.0f} episodes."
            for name, result in results.items()
            if result["episodes"] < most
        ]
        origins = dict.fromkeys(r.get("origin", entry.get("origin")) for r in results.values())
        note = " ".join([f"In {most:.0f} episodes.", *fewer, f"Made at {'; '.join(origins)}."])
        text += [controllers_table(task, results), f"{note}\n"]
    return "\n".join(text)


def write(entries: dict[str, Any], out: Path) -> None:
    """The results as JSON and as a page of tables."""
    (out / "README.md").write_text(page(entries))
    (out / "baselines.json").write_text(json.dumps(entries, indent=1) + "\n")


def main(words: Sequence[str] | None = None) -> None:
    """Measure what has not been measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=Path, default=Path("results/agents"))
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--baselines", nargs="+", choices=list(BASELINES), default=list(BASELINES))
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--slow-episodes", type=int, default=10, help="of those that plan")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "baselines.json"
    entries = json.loads(path.read_text()) if path.is_file() else {}
    for task in arguments.tasks:
        place = arguments.agents / task
        agent = load_agent(place)
        weights = hashlib.sha256((place / "weights.safetensors").read_bytes()).hexdigest()
        if entries.get(task, {}).get("weights") != weights:
            entries[task] = {"weights": weights, "results": {}}
        results = entries[task]["results"]
        for name in (*LEARNED, *applying(agent, arguments.baselines)):
            if name in results:
                continue
            slow = name not in LEARNED and BASELINES[name].slow
            episodes = arguments.slow_episodes if slow else arguments.episodes
            origin = {"origin": origin_text(describe_origin(seed=0))}
            results[name] = measure(agent, name, episodes) | origin
            write(entries, arguments.out)
        print(controllers_table(task, results), flush=True)


if __name__ == "__main__":
    main()
