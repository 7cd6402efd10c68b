"""From how many starts actors of no skill, and learned ones, are at the floor of returns.

    python benchmarks/paper/floors.py

The policy phase tries another strategy where its best actor is at the floor from more than 15 % of
the starts at the end of a way to learn, or from 90 % half-way (``docs/imagination.md``). Here the
same measure is taken, in the models of results/agents, of actors without any training, and of the
agents' own. The thresholds have to lie between the two. A full action that never changes is played
as well: where it alone moves a system, it is above the floor, and is told from skill by nothing
here. Writes results/floors/.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl import load_agent, load_config
from phihp_torchrl.agents import Actor
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import TARGETS, markdown_table
from phihp_torchrl.imagination import Rollouts, make_start_states
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.tasks import ActionBounds, Task
from phihp_torchrl.trainers import Floor, read_run_config

AGENTS, RESULTS = Path("results/agents"), Path("results/floors")
SEED, STARTS, UNTRAINED = 0, 64, 5
WIDE = 4096

Policy = Callable[[Tensor], Tensor]


def returns(model: TaskWorldModel, policy: Policy, states: Tensor, steps: int) -> Tensor:
    """Imagined returns of a policy, ``[N]``."""

    def act(weights: Sequence[Tensor], observation: Tensor, bounds: ActionBounds) -> Tensor:
        return bounds.clip(policy(observation))

    return Rollouts(model, act, steps).returns([], states, steps).total


def policies(task: Task, actor: Any, untrained: int) -> dict[str, list[Any]]:
    """Policies by what they are."""
    center, scale = task.bounds.center, task.bounds.scale
    full = [
        lambda seen, sign=sign: (center + sign * scale).expand(len(seen), -1) for sign in (-1, 1)
    ]
    fresh = []
    for seed in range(untrained):
        torch.manual_seed(seed)
        fresh.append(Actor(task))
    return {"untrained": fresh, "full action": full, "learned": [actor]}


@torch.no_grad()
def measure(name: str, starts: int, untrained: int) -> dict[str, Any]:
    """The shares of starts at the floor of a task's policies."""
    agent = load_agent(AGENTS / name, planner=False)
    task, dynamics = agent.task, agent.dynamics
    assert dynamics is not None
    assert agent.actor is not None
    model = TaskWorldModel(task, dynamics)
    states = task.sample_start([starts], torch.Generator().manual_seed(SEED))
    start = read_run_config(load_config(name)).section("policy").start
    wide = make_start_states(task, start).sample([WIDE], torch.Generator().manual_seed(SEED))
    floor = Floor(model, states, task.max_steps, seed=SEED, wide=wide)
    shares = {
        kind: [floor.share(returns(model, each, states, task.max_steps)) for each in ours]
        for kind, ours in policies(task, agent.actor.module, untrained).items()
    }
    return {"task": name, "starts": starts, "shares": shares, "origin": describe_origin(SEED)}


def write(results: Path) -> str:
    """Write the table of all tasks so far; returns it."""
    found = {path.stem: json.loads(path.read_text()) for path in results.glob("*.json")}
    every = [found[name] for name in TARGETS if name in found]
    rows = []
    for each in every:
        row = [each["task"]]
        for shares in each["shares"].values():
            low, high = (f"{100 * share:.0f} %" for share in (min(shares), max(shares)))
            row.append(low if len(shares) == 1 else f"{low} to {high}")
        rows.append(row)
    table = markdown_table(["task", *every[0]["shares"]], rows)
    counts = sorted({each["starts"] for each in every})
    actors = sorted({len(each["shares"]["untrained"]) for each in every})
    origins = sorted({origin_text(each["origin"]) for each in every})
    (results / "README.md").write_text(
        "# Starts at the floor of returns\n\n"
        "Made by `python benchmarks/paper/floors.py`. Do not edit. The share of "
        f"{', '.join(map(str, counts))} starts from which a policy earns no more in the model of "
        "`results/agents` than by doing nothing or anything, as the policy phase measures it: of "
        f"{', '.join(map(str, actors))} untrained actors and of the full action in either "
        "direction the least and the largest, and of the agent's own actor.\n\n"
        f"{table}\nMade at {'; '.join(origins)}.\n"
    )
    return table


def main(words: Sequence[str] | None = None) -> None:
    """Measure the tasks that the words name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=list(TARGETS))
    parser.add_argument("--starts", type=int, default=STARTS)
    parser.add_argument("--untrained", type=int, default=UNTRAINED)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    arguments.results.mkdir(parents=True, exist_ok=True)
    for name in arguments.tasks:
        result = measure(name, arguments.starts, arguments.untrained)
        (arguments.results / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
        print(write(arguments.results), flush=True)


if __name__ == "__main__":
    main()
