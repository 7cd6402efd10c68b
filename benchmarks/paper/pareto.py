"""Return against latency of plans of several budgets, and the cheapest that loses nothing.

    python benchmarks/paper/pareto.py --tasks pendulum-swingup acrobot
    python benchmarks/paper/pareto.py --report               # the choice, on evaluation seeds, once

Reads the agents in results/agents; tasks that were swept before stay. The sweep plays paired
episodes from seeds of training, and its choice is the budget with the fewest milliseconds whose
return is, on no task, below the published budget's by more than a standard error and a quarter of a
percent. Only --report plays evaluation seeds: the published budget and the chosen one, 50 paired
episodes. Writes results/pareto/.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

import torch
from matplotlib.figure import Figure
from tensordict import TensorDict

from measures import PairedDifference, paired_difference
from phihp_torchrl import load_agent, load_config
from phihp_torchrl.config import read_kind
from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import EVALUATION_SEED, TARGETS, evaluate, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.planners import PLANNERS, CEMConfig, SamplingPlanner, make_planner

AGENTS, RESULTS = Path("results/agents"), Path("results/pareto")
TURN = 10  # actions of a planner before the next one's
NEGLIGIBLE = 0.0025  # share of the published budget's return
SWEEP_SEED = 0  # of training: the choice must not see an evaluation seed
REPORT_EPISODES = 50
BUDGETS = {
    "220 x 3, published": {},
    "64 x 2": {"num_candidates": 64, "optim_steps": 2, "num_kept_elites": 2},
    "32 x 2": {"num_candidates": 32, "optim_steps": 2, "num_kept_elites": 2},
    "32 x 2, 3 actions ahead": {
        "num_candidates": 32,
        "optim_steps": 2,
        "num_kept_elites": 2,
        "planning_horizon": 3,
    },
    "96 x 1": {"num_candidates": 96},
    "64 x 1": {"num_candidates": 64},
    "32 x 1": {"num_candidates": 32},
}
"""What a budget sets: nothing over the published planner, or over what all of ours share."""
PUBLISHED = next(iter(BUDGETS))
OURS = {
    "planning_horizon": 5,
    "optim_steps": 1,
    "top_k": 6,
    "num_policy_candidates": 8,
    "policy_noise": 0.2,
    "policy_noise_clip": 0.6,
    "init_std": 1.0,
    "noise_beta": 0.0,
    "select": "mean",
    "num_kept_elites": 0,
    "compare_with_actor": True,
    "warm_start": True,
    "keep_incumbent": False,
}


def planner_config(task: str, name: str) -> CEMConfig:
    """The published planner of the task; for our budgets the default preset's, with changes."""
    if name == PUBLISHED:
        return preset_planner(task, "paper")
    changes: dict[str, Any] = {**OURS, **BUDGETS[name]}
    return replace(preset_planner(task, "default"), **changes)


@cache
def preset_planner(task: str, preset: str) -> CEMConfig:
    """The planner of a preset on a task."""
    return read_kind(PLANNERS, load_config(task, preset=preset)["planner"], "planner")


def build(agent: Agent, name: str, compile: bool = False) -> SamplingPlanner:
    """The planner of a budget."""
    assert agent.dynamics is not None  # agents of PhIHP
    model = TaskWorldModel(agent.task, agent.dynamics)
    config = planner_config(agent.task.name, name)
    return make_planner(model, agent.actor, agent.qvalue, config, compile=compile)


def latencies(planners: dict, agent: Agent, calls: int) -> dict[str, float]:
    """Median milliseconds of an action, CPU time of the one thread.

    Planners take turns of ``TURN`` actions, for one alone does not share its cache with others.
    """
    states = (agent.task.coverage or agent.task.reset).sample([calls])
    times: dict[str, list[float]] = {name: [] for name in planners}
    for turn in agent.task.observe(states).split(TURN):
        for name, planner in planners.items():
            data = [TensorDict(observation=o, is_init=torch.tensor([True])) for o in turn]
            start = time.thread_time()
            for situation in data:
                planner(situation)
            times[name].append(1e3 * (time.thread_time() - start) / len(data))
    return {name: median(of[len(of) // 10 :]) for name, of in times.items()}


def description(agent: Agent, name: str, seed: int, episodes: int) -> dict[str, Any]:
    """What returns depend on: they need not be played again where it is the same."""
    return {
        "settings": asdict(planner_config(agent.task.name, name)),
        "agent": [agent.metadata.get(key) for key in ("commit", "seed", "samples")],
        "seeds": [seed, episodes],
    }


def sweep(task: str, episodes: int, calls: int, before: dict[str, Any]) -> dict[str, Any]:
    """Returns and latency of every budget on a task; what was played before stays."""
    agent = load_agent(AGENTS / task, packaged=False)
    compiled = {name: build(agent, name, compile=True) for name in BUDGETS}
    milliseconds = latencies(compiled, agent, calls)
    rows: dict[str, Any] = {}
    for name in BUDGETS:
        same = description(agent, name, SWEEP_SEED, episodes)
        returns = before.get(name, {}).get("returns")
        if returns is None or any(before[name].get(key) != value for key, value in same.items()):
            torch.manual_seed(SWEEP_SEED)
            played = evaluate(build(agent, name), agent.task, episodes=episodes, seed=SWEEP_SEED)
            returns = played.returns.tolist()
        rows[name] = {"ms": milliseconds[name], "returns": returns, **same}
        mean = sum(returns) / len(returns)
        print(f"{task}: {name}: {mean:.1f}, {milliseconds[name]:.2f} ms", flush=True)
    return rows


def difference(rows: dict[str, Any], name: str) -> PairedDifference:
    """Mean and standard error of a budget's returns less the published one's."""
    ours, theirs = (torch.tensor(rows[key]["returns"]) for key in (name, PUBLISHED))
    return paired_difference(ours, theirs)


def loses(rows: dict, name: str) -> bool:
    """Whether a budget earns less than the published one, by more than chance or `NEGLIGIBLE`."""
    gap, published = difference(rows, name), torch.tensor(rows[PUBLISHED]["returns"]).mean()
    return -gap.mean > max(gap.standard_error, NEGLIGIBLE * abs(published.item()))


def choose(tasks: dict[str, dict]) -> str:
    """The cheapest budget that loses on no task."""
    good = [name for name in BUDGETS if not any(loses(rows, name) for rows in tasks.values())]
    return min(good, key=lambda name: sum(rows[name]["ms"] for rows in tasks.values()))


def report(task: str, chosen: str, calls: int, before: dict[str, Any]) -> dict[str, Any]:
    """The choice against the published budget, on evaluation seeds; both played once, ever."""
    agent = load_agent(AGENTS / task, packaged=False)
    fast = build(agent, chosen, compile=True)
    planners = {"published, eager": build(agent, PUBLISHED), "chosen, compiled": fast}
    milliseconds = latencies(planners, agent, calls)
    same = description(agent, chosen, EVALUATION_SEED, REPORT_EPISODES)
    if any(before.get(key) != value for key, value in same.items()):
        ours, theirs = (
            evaluate(build(agent, name), agent.task, episodes=REPORT_EPISODES, seed=EVALUATION_SEED)
            for name in (chosen, PUBLISHED)
        )
        paired = paired_difference(ours.returns, theirs.returns)
        before = {
            "published_return": theirs.mean,
            "return": ours.mean,
            "difference": paired.mean,
            "standard_error": paired.standard_error,
        }
    return {
        **before,
        **same,
        "published_eager_ms": milliseconds["published, eager"],
        "chosen_compiled_ms": milliseconds["chosen, compiled"],
    }


def origins(of: dict[str, str]) -> str:
    """Commit and machine of each task, in a sentence."""
    return "Made at: " + "; ".join(f"{task}, {text}" for task, text in of.items()) + ".\n"


def write(results: dict) -> None:
    """Tables and picture of all tasks done so far."""
    tasks = results["tasks"]
    figure = Figure(figsize=(3.2 * len(tasks), 3.0), layout="constrained")
    panels = figure.subplots(1, len(tasks), squeeze=False)[0]
    lines = []
    for axis, (task, rows) in zip(panels, tasks.items(), strict=True):
        for name, row in rows.items():
            returns = torch.tensor(row["returns"])
            gap = difference(rows, name)
            axis.errorbar(
                row["ms"],
                returns.mean(),
                yerr=gap.standard_error,
                marker="s" if name == PUBLISHED else "o",
                label=name,
            )
            cells = [f"{row['ms']:.2f}", f"{returns.mean():.1f}"]
            gap_text = f"{gap.mean:+.1f} ± {gap.standard_error:.1f}"
            lines.append([task, str(len(returns)), name, *cells, gap_text])
        axis.set_title(task)
        axis.set_xscale("log")
        axis.set_xlabel("ms for an action")
    panels[0].set_ylabel("return")
    panels[-1].legend(fontsize=6)
    RESULTS.mkdir(parents=True, exist_ok=True)
    figure.savefig(RESULTS / "pareto.png", dpi=110)
    (RESULTS / "pareto.json").write_text(json.dumps(results, indent=1) + "\n")
    header = ["task", "episodes", "candidates x iterations", "ms", "return", "less the published"]
    text = (
        "# Return against latency\n\n"
        "Made by `python benchmarks/paper/pareto.py`. Paired episodes from seeds of training; "
        f"compiled plans, CPU milliseconds. Chosen: **{choose(tasks)}**.\n\n"
        "![pareto](pareto.png)\n\n"
        f"{markdown_table(header, lines)}\n{origins(results['origins'])}"
    )
    if reported := results.get("report"):
        header = ["task", "chosen", "published", "return", "difference", "published, eager, ms"]
        header += ["chosen, compiled, ms", "times faster"]
        lines = [
            [
                task,
                row["chosen"],
                f"{row['published_return']:.1f}",
                f"{row['return']:.1f}",
                f"{row['difference']:+.1f} ± {row['standard_error']:.1f}",
                f"{row['published_eager_ms']:.2f}",
                f"{row['chosen_compiled_ms']:.2f}",
                f"{row['published_eager_ms'] / row['chosen_compiled_ms']:.1f}",
            ]
            for task, row in reported["rows"].items()
        ]
        text += (
            "\n## On evaluation seeds\n\n`python benchmarks/paper/pareto.py --report`: "
            f"{REPORT_EPISODES} paired episodes.\n\n{markdown_table(header, lines)}\n"
            f"{origins({task: row['origin'] for task, row in reported['rows'].items()})}"
        )
    (RESULTS / "README.md").write_text(text)


@torch.no_grad()
def main() -> None:
    """Sweep, or report the choice."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--episodes", type=int, default=20, help="a budget, from training seeds")
    parser.add_argument("--calls", type=int, default=400, help="timed actions a budget")
    parser.add_argument("--report", action="store_true", help="the choice, on evaluation seeds")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(SWEEP_SEED)
    path = RESULTS / "pareto.json"
    origin = origin_text(describe_origin(SWEEP_SEED))
    results = json.loads(path.read_text()) if path.is_file() else {"tasks": {}, "origins": {}}
    if arguments.report:
        chosen = choose(results["tasks"])
        rows = results.get("report", {}).get("rows", {})
        for task in arguments.tasks:
            found = report(task, chosen, arguments.calls, rows.get(task, {}))
            rows[task] = {**found, "chosen": chosen, "origin": origin}
            results["report"] = {"rows": rows}
            write(results)
        return
    # What was swept with other budgets cannot be compared, nor can a report on what they were.
    before = results["tasks"]
    same = [task for task, rows in before.items() if list(rows) == list(BUDGETS)]
    results = {key: {task: results[key][task] for task in same} for key in ("tasks", "origins")}
    for task in arguments.tasks:
        known = before.get(task, {})
        results["tasks"][task] = sweep(task, arguments.episodes, arguments.calls, known)
        results["origins"][task] = origin
        write(results)


if __name__ == "__main__":
    main()
