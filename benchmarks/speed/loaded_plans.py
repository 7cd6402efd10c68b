"""A plan of a saved agent out of the box, beside an eager planner of the published budget.

    python benchmarks/speed/loaded_plans.py
    python benchmarks/speed/loaded_plans.py --tasks acrobot --agents outputs/my-agents

For each agent that acts by a plan: the seconds of packaging it, the time of a plan as load_agent
gives it, of the same plan eagerly, and of the published budget with the same networks, which take
turns; then the returns of both budgets in the same 50 episodes. For the first of them there is also
the package of the same plan with its steps written out one after the other, in place of a loop.
Writes results/loaded_plans; times are those of the one thread, without what it waited for.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from race import figures
from tensordict import TensorDict

from phihp_torchrl import load_agent, load_config, save_agent
from phihp_torchrl.config import read_kind
from phihp_torchrl.evaluation import EVALUATION_SEED, evaluate, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.planners import PLANNERS, sampling_planner
from phihp_torchrl.tasks import list_tasks

RESULTS = Path("results/loaded_plans")
ROUNDS, EPISODES = 200, 50


def packaged(agent: Any, *, looped: bool = True) -> tuple[Any, float]:
    """The agent as load_agent gives it after it was saved with a package, and the seconds of it."""
    longest = sampling_planner.LONG_PLAN if looped else math.inf
    with (
        tempfile.TemporaryDirectory() as place,
        mock.patch.object(sampling_planner, "LONG_PLAN", longest),
    ):
        start = time.perf_counter()
        save_agent(agent, place, packaged=True)
        seconds = time.perf_counter() - start
        loaded = load_agent(place)
        if not loaded.planner._functions._replaced:
            raise RuntimeError("load_agent did not take the package; what it logged says why.")
        return loaded, seconds


def measure(task: str, place: Path, *, written_out: bool) -> dict[str, Any] | None:
    """The figures of one agent; ``None`` for one that acts without a plan."""
    eager = load_agent(place / task, packaged=False)
    if eager.planner is None:
        return None
    budget = read_kind(PLANNERS, load_config(task, preset="paper")["planner"], "planner")
    published = eager.with_planner(budget)
    ours, seconds = packaged(eager)
    agents = {"published, eager": published, "as loaded": ours, "eager": eager}
    row: dict[str, Any] = {"task": task, "package_s": seconds}
    if written_out:
        agents["written out"], row["written_out_s"] = packaged(eager, looped=False)
    times: dict[str, list[float]] = {name: [] for name in agents}
    states = eager.task.sample_start([ROUNDS + 3], torch.Generator().manual_seed(EVALUATION_SEED))
    for i, observation in enumerate(eager.task.observe(states)):
        for name, agent in agents.items():
            seen = TensorDict(observation=observation)
            start = time.thread_time()
            agent(seen)
            if i >= 3:
                times[name].append(1e3 * (time.thread_time() - start))
    for key in ("ms", "ratio"):
        row[key] = {each["contender"]: each[key] for each in figures(times)}
    returns = [
        evaluate(agent, task, episodes=EPISODES, seed=EVALUATION_SEED).returns
        for agent in (eager, published)
    ]
    gap = returns[0] - returns[1]
    row["return"], row["published_return"] = (each.mean().item() for each in returns)
    row["gap"], row["gap_se"] = gap.mean().item(), gap.std().item() / math.sqrt(len(gap))
    return row


def write(record: dict[str, Any]) -> None:
    """The record as JSON, and as a table."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "loaded_plans.json").write_text(json.dumps(record, indent=2) + "\n")
    header = ["task", "as loaded, ms", "eager", "published, eager", "ratio to the published",
              "return", "published", "difference"]  # fmt: skip
    cells = [
        [
            row["task"],
            *(f"{row['ms'][name]:.2f}" for name in ("as loaded", "eager", "published, eager")),
            f"{row['ratio']['as loaded']:.2f}",
            f"{row['return']:.1f}",
            f"{row['published_return']:.1f}",
            f"{row['gap']:+.1f} ± {row['gap_se']:.1f}",
        ]
        for row in record["rows"]
    ]
    text = (
        "# A plan out of the box\n\n"
        "Made by `python benchmarks/speed/loaded_plans.py`. Contenders take turns; *ms* is the "
        "median of a plan, and *ratio* the median over turns of a plan as loaded to one of the "
        f"published budget, eager, with the same networks. Returns are those of {EPISODES} paired "
        "episodes, with a standard error over them: one agent, so no claim about training.\n\n"
        f"{markdown_table(header, cells)}\n\n"
    )
    for row in record["rows"]:
        text += f"Packaging {row['task']}: {row['package_s']:.0f} s"
        if "written_out_s" in row:
            text += (
                f"; with its steps written out {row['written_out_s']:.0f} s, and a plan takes "
                f"{row['ms']['written out']:.2f} ms"
            )
        text += ".\n"
    for task in record["actors"]:
        text += f"{task}: its agent acts without a plan.\n"
    (RESULTS / "README.md").write_text(f"{text}\n{record['machine']}\n")


def main() -> None:
    """Measure the agents of the tasks, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=None)
    parser.add_argument("--agents", type=Path, default=Path("results/agents"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = [task for task in list_tasks() if (given.agents / task).is_dir()]
    record: dict[str, Any] = {"rows": [], "actors": []}
    for task in given.tasks or known:
        row = measure(task, given.agents, written_out=not record["rows"])
        record["rows" if row else "actors"].append(row or task)
        record["machine"] = f"{origin_text(describe_origin(seed=0))}, torch {torch.__version__}."
        write(record)
        print(row or f"{task}: no plan", flush=True)


if __name__ == "__main__":
    main()
