"""A plan of a saved agent out of the box, beside an eager planner of the published budget.

    python benchmarks/speed/loaded_plans.py
    python benchmarks/speed/loaded_plans.py --tasks acrobot --agents outputs/my-agents

For each agent that acts by a plan: the seconds of packaging it, the time of a plan as load_agent
gives it, of the same plan eagerly, of ``budget=fast`` in a package, of the published budget with
the same networks, and of the actor, which take turns of six plans; then the returns of the three
budgets in the same 50 episodes. The first plan of a turn finds the caches full of what the others
computed, as beside other work on a robot; the five after it follow one another, as in an
evaluation. With ``--written-out`` there is also a package of the plan whose steps are written
out one after the other, in place of a loop. Writes results/loaded_plans, where tasks that are not
measured stay; times are those of the one thread, without what it waited for.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
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
ROUNDS, IN_A_TURN, EPISODES = 60, 6, 50
BUDGETS = {"published, eager": "published", "as loaded": "as loaded", "fast, loaded": "fast"}
"""The budget whose return is that of a contender."""


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
    published, fast = (
        eager.with_planner(read_kind(PLANNERS, settings["planner"], "planner"))
        for settings in (
            load_config(task, preset="paper"),
            load_config(task, overrides=["budget=fast"]),
        )
    )
    ours, seconds = packaged(eager)
    agents = {
        "published, eager": published,
        "as loaded": ours,
        "eager": eager,
        "fast, loaded": packaged(fast)[0],
        "actor": eager.actor_alone(),
    }
    origin = f"{origin_text(describe_origin(seed=0))}, torch {torch.__version__}"
    row: dict[str, Any] = {"task": task, "package_s": seconds, "origin": origin}
    if written_out:
        agents["written out"], row["written_out_s"] = packaged(eager, looped=False)
    times: dict[str, dict[str, list[float]]] = {
        "first": {name: [] for name in agents},
        "after": {name: [] for name in agents},
    }
    generator = torch.Generator().manual_seed(EVALUATION_SEED)
    for i in range(ROUNDS + 1):
        observations = eager.task.observe(eager.task.sample_start([IN_A_TURN], generator))
        for name, agent in agents.items():
            first, *after = [1e3 * timed(agent, each) for each in observations]
            if i:  # the first round of all is for what is built at a first call
                times["first"][name].append(first)
                times["after"][name].append(statistics.median(after))
    for which, raced in times.items():
        for key in ("ms", "ratio"):
            row[f"{key}_{which}"] = {each["contender"]: each[key] for each in figures(raced)}
    returns = {
        name: evaluate(agent, task, episodes=EPISODES, seed=EVALUATION_SEED).returns
        for name, agent in {"published": published, "as loaded": eager, "fast": fast}.items()
    }
    row["returns"] = {name: each.mean().item() for name, each in returns.items()}
    row["ahead"] = {name: _ahead(returns[name], returns["published"]) for name in returns}
    return row


def timed(agent: Any, observation: torch.Tensor) -> float:
    """The thread's seconds of one action."""
    seen = TensorDict(observation=observation)
    start = time.thread_time()
    agent(seen)
    return time.thread_time() - start


def _ahead(ours: torch.Tensor, theirs: torch.Tensor) -> tuple[float, float]:
    """The mean paired difference, and its standard error."""
    gap = ours - theirs
    return gap.mean().item(), gap.std().item() / math.sqrt(len(gap))


def write(record: dict[str, Any]) -> None:
    """The record as JSON, and as a table."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "loaded_plans.json").write_text(json.dumps(record, indent=2) + "\n")
    header = ["task", "plan", "ms", "ratio", "first ms", "its ratio", "return", "ahead"]
    cells = []
    for row in record["rows"]:
        for name in row["ms_after"]:
            budget = BUDGETS.get(name)
            earned = "" if budget is None else f"{row['returns'][budget]:.1f}"
            ahead = "" if budget is None else "{:+.1f} ± {:.1f}".format(*row["ahead"][budget])
            times = [
                f"{row[f'{key}_{which}'][name]:.3g}"
                for which in ("after", "first")
                for key in ("ms", "ratio")
            ]
            cells.append([row["task"], name, *times, earned, ahead])
    text = (
        "# A plan out of the box\n\n"
        f"Made by `python benchmarks/speed/loaded_plans.py`. Contenders take {ROUNDS} turns of "
        f"{IN_A_TURN} plans. *ms* is the median of plans that follow one another, and *ratio* the "
        "median over turns of their time to that of the published budget, eager, with the same "
        "networks; the next two are those of the first plan of a turn, which finds the caches full "
        "of what the others computed. *As loaded* is what `load_agent` gives whoever made the "
        f"agent; *fast, loaded* is `budget=fast`. Returns are those of {EPISODES} paired episodes, "
        "*ahead* is the difference to the published budget, with a standard error over them: one "
        "agent, so no claim about training.\n\n"
        f"{markdown_table(header, cells)}\n\n"
    )
    for row in record["rows"]:
        text += f"Packaging {row['task']}: {row['package_s']:.0f} s"
        if "written_out_s" in row:
            text += (
                f"; with its steps written out {row['written_out_s']:.0f} s, and a plan takes "
                f"{row['ms_after']['written out']:.2f} ms"
            )
        text += f" ({row['origin']}).\n"
    for task in record["actors"]:
        text += f"{task}: its agent acts without a plan.\n"
    (RESULTS / "README.md").write_text(text)


def main() -> None:
    """Measure the agents of the tasks, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=None)
    parser.add_argument("--agents", type=Path, default=Path("results/agents"))
    parser.add_argument("--written-out", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = [task for task in list_tasks() if (given.agents / task).is_dir()]
    record: dict[str, Any] = {"rows": [], "actors": []}
    if (RESULTS / "loaded_plans.json").is_file():
        record = json.loads((RESULTS / "loaded_plans.json").read_text())
        record["rows"] = [row for row in record["rows"] if "ms_after" in row]
    for task in given.tasks or known:
        row = measure(task, given.agents, written_out=given.written_out)
        record["rows"] = [old for old in record["rows"] if old["task"] != task]
        record["actors"] = [old for old in record["actors"] if old != task]
        record["rows" if row else "actors"].append(row or task)
        write(record)
        print(row or f"{task}: no plan", flush=True)


if __name__ == "__main__":
    main()
