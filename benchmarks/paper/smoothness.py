"""Return against smoothness of the shipped agents, and of plans that nothing has calibrated.

    python benchmarks/paper/smoothness.py --tasks pendulum-swingup cartpole
    python benchmarks/paper/smoothness.py --tasks     # table and picture of what there is

Plays the agents in results/agents as they are, which calibration in imagination has made calm, with
the plans of the preset, as they were before, with a price of changes in these (change_cost), and
without plans, in the same episodes of evaluation. Chatter is what ``Evaluation.chatter`` measures.
It chooses nothing. Writes results/smoothness/; tasks that were played before stay.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from phihp_torchrl import load_agent, load_config
from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation import EVALUATION_SEED, TARGETS, evaluate, markdown_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.trainers import read_run_config

AGENTS, RESULTS = Path("results/agents"), Path("results/smoothness")
PRICES = (0.3, 1.0)
"""Prices of a change of the action in the preset's plans, beside none."""
EPISODES = 10


def controllers(agent: Agent) -> dict[str, Agent]:
    """The agent as it is shipped, plans as they are before calibration, and the actor alone."""
    search = read_run_config(load_config(agent.task.name)).planner
    assert search is not None
    if agent.planner_config is not None:  # the critics' discount, which a strategy may have changed
        search = replace(search, gamma=agent.planner_config.gamma)
    priced = {
        f"plans of the preset, change_cost {price:g}": agent.with_planner(
            replace(search, change_cost=price)
        )
        for price in PRICES
    }
    plans = {"plans of the preset": agent.with_planner(search), **priced}
    return {"as shipped": agent, **plans, "actor": agent.actor_alone()}


def measure(agent: Agent, episodes: int) -> dict[str, Any]:
    """What the evaluation says, with the return and the chatter of every episode."""
    played = evaluate(agent, agent.task, episodes=episodes, seed=EVALUATION_SEED)
    assert played.chatter is not None  # evaluate measures it
    summary = {**played.summary(), "standard_error": played.standard_error}
    lists = {"returns": played.returns.tolist(), "chatters": played.chatter.tolist()}
    return summary | lists


def write(result: Mapping[str, Any] | None, results: Path) -> None:
    """Write what a task's controllers measured, and the table and picture of all tasks so far.

    Without a result it writes table and picture alone.
    """
    results.mkdir(parents=True, exist_ok=True)
    if result is not None:
        (results / f"{result['task']}.json").write_text(json.dumps(result, indent=1) + "\n")
    every = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    draw(every).savefig(results / "smoothness.png", dpi=110)
    rows = [
        [each["task"], name, f"{m['return_mean']:.1f}", f"{m['standard_error']:.1f}",
         f"{m['chatter']:.3f}"]
        for each in every
        for name, m in each["measured"].items()
    ]  # fmt: skip
    missing = [task for task in TARGETS if task not in {each["task"] for each in every}]
    commits = sorted({commit_text(each["origin"]) for each in every})
    machines = sorted({machine_text(each["origin"]) for each in every})
    episodes = sorted({each["episodes"] for each in every})
    (results / "README.md").write_text(
        "# Return against smoothness\n\n"
        "Made by `python benchmarks/paper/smoothness.py`. Do not edit. The agents of "
        f"`results/agents/` in {', '.join(map(str, episodes))} episodes of evaluation, the same "
        "for all rows of a task. Chatter is the mean change of the action from step to step in "
        "the second half of episodes, as a share of its half-range. Nothing is chosen here. *As "
        "shipped* is what calibration in imagination has chosen, a plan or the actor; *plans of "
        "the preset* are what it chose from.\n\n"
        "![Return against chatter](smoothness.png)\n\n"
        f"{markdown_table(['task', 'controller', 'return', 's.e.', 'chatter'], rows)}\n"
        f"Not run: {', '.join(missing) or 'none'}.\n\n"
        f"Commits: {', '.join(commits)}. Machines: {', '.join(machines)}.\n"
    )


def draw(every: Sequence[Mapping[str, Any]]) -> Figure:
    """A panel for each task: return against chatter, with standard errors."""
    columns = min(len(every), 3)
    rows = -(-len(every) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.2 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for axis in axes[len(every) :]:
        axis.set_visible(False)
    for axis, each in zip(axes, every, strict=False):
        for name, found in each["measured"].items():
            point = (found["chatter"], found["return_mean"])
            axis.errorbar(*point, yerr=found["standard_error"], marker="o", label=name)
        axis.set_title(each["task"], fontsize=9)
        axis.set_xlabel("chatter")
        axis.set_ylabel("return")
        axis.legend(fontsize=6)
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Play the tasks that the words name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="*", default=list(TARGETS))
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--agents", type=Path, default=AGENTS)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    for task in arguments.tasks:
        agent = load_agent(arguments.agents / task, packaged=False)
        measured = {}
        for name, each in controllers(agent).items():
            measured[name] = measure(each, arguments.episodes)
            print(f"{task}, {name}: {measured[name]['return_mean']:.1f}", flush=True)
        write(
            {
                "task": task,
                "episodes": arguments.episodes,
                "seed": EVALUATION_SEED,
                "measured": measured,
                "origin": describe_origin(0),
            },
            arguments.results,
        )
    if not arguments.tasks:
        write(None, arguments.results)


if __name__ == "__main__":
    main()
