"""Policy gradients through the model beside TD3, on the tasks of the paper, in time and return.

    python benchmarks/paper/analytic.py --seeds 100 101 102

Both ways to learn in imagination (``policy.method``) train in the models of results/agents, with
the default preset of the task, until each has used --budget seconds of processor time, compiling
included in neither. Critics are not fitted to returns meanwhile. Writes
results/analytic/<task>-<method>-seed<seed>.json after every run, and a README.md beside them. Runs
that are there already are not repeated, so an interrupted command is simply given again. Settings
are chosen with seeds below 100 (and --results elsewhere), and reported with others.
"""

from __future__ import annotations

import argparse
import json
import logging
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from measures import mean_and_half
from phihp_torchrl import get_task, load_agent, load_config, make_world
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.trainers import PolicyTrainer, read_run_config

RESULTS, AGENTS = Path("results/analytic"), Path("results/agents")
TASKS = (
    "pendulum-swingup",
    "cartpole-swingup",
    "pendulum",
    "cartpole",
    "acrobot",
    "acrobot-swingup",
)
METHODS = ("td3", "analytic")
# A policy is good once it has gone this share of the way from the first actor to the agent's.
_GOOD = 0.9


def settings(method: str, seed: int) -> list[str]:
    """The settings of a run, as on a command line of ``phihp train``."""
    return [f"policy.method={method}", "policy.refit.interval=0", f"seed={seed}"]


def train(task_name: str, method: str, seed: int, budget: float) -> dict[str, Any]:
    """One run: returns in the model and in the world against processor seconds and updates."""
    lines = settings(method, seed)
    config = read_run_config(load_config(task_name, overrides=lines)).section("policy")
    task = get_task(task_name)
    agent = load_agent(AGENTS / task_name, planner=False)
    if agent.dynamics is None:
        raise LookupError(f"{AGENTS / task_name}: the agent has no model to imagine with.")
    torch.manual_seed(seed)
    trainer = PolicyTrainer(
        task, agent.dynamics, config, world=make_world(task), seed=seed, compile=True
    )
    _compile(trainer)
    points = [{"seconds": 0.0, "updates": 0.0, **_returns(trainer)}]
    spent = 0.0
    while not trainer.done and spent < budget:
        begun = time.process_time()
        learned = trainer.learner.learn(trainer.updates + config.evaluation_interval)
        spent += time.process_time() - begun
        metrics = {name: value.item() for name, value in learned.items()}
        point = {"seconds": spent, "updates": float(trainer.updates), **_returns(trainer)}
        points.append({**point, **metrics})
    return {
        "task": task_name,
        "method": method,
        "seed": seed,
        "budget": budget,
        "settings": lines,
        "points": points,
        "origin": describe_origin(seed),
    }


def _compile(trainer: PolicyTrainer) -> None:
    """Call everything once, and take back what that has changed."""
    before = _copied(trainer.state_dict())
    trainer.learner.learn(trainer.config.analytic.critic_updates)
    _returns(trainer)
    trainer.load_state_dict(before)


def _copied(state: Any) -> Any:
    if isinstance(state, dict):
        return {key: _copied(value) for key, value in state.items()}
    if isinstance(state, list):
        return [_copied(value) for value in state]
    return state.clone() if isinstance(state, torch.Tensor) else state


def _returns(trainer: PolicyTrainer) -> dict[str, float]:
    actor = trainer.update.networks.actor
    real = trainer.evaluation.real(actor)["policy/real_return"]
    return {
        "imagined": trainer.evaluation.mean(trainer.evaluation.imagined(actor).returns),
        "real": real,
    }


def best(run: dict[str, Any]) -> dict[str, float]:
    """The point of the actor to keep, by its imagined return."""
    return max(run["points"], key=lambda point: point["imagined"])


def good_after(run: dict[str, Any], level: float) -> float | None:
    """Processor seconds until the imagined return is first at ``level``."""
    reached = (point["seconds"] for point in run["points"] if point["imagined"] >= level)
    return next(reached, None)


def write_tables(results: Path, tasks: Sequence[str]) -> None:
    """Write README.md from all runs that are there."""
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*-seed*.json"))]
    rows = []
    for task in tasks:
        ours = [run for run in runs if run["task"] == task]
        if not ours:
            continue
        top = max(best(run)["imagined"] for run in ours)
        first = statistics.mean(run["points"][0]["imagined"] for run in ours)
        level = first + _GOOD * (top - first)
        for method in METHODS:
            if of := [run for run in ours if run["method"] == method]:
                rows.append(_row(task, method, of, level))
    head = (
        "task", "method", "seeds", "ms an update", "updates", "best imagined return",
        "its return in the world", "seconds to a good policy", "gradients limited",
    )  # fmt: skip
    budgets = sorted({run["budget"] for run in runs})
    seeds = sorted({run["seed"] for run in runs})
    commits = sorted({commit_text(run["origin"]) for run in runs})
    machines = sorted({machine_text(run["origin"]) for run in runs})
    text = "\n\n".join(
        [
            "# Policy gradients through the model, and TD3",
            "Made by `python benchmarks/paper/analytic.py`. Do not edit. Both train in the models "
            "of `results/agents`, with the default preset, for "
            f"{' or '.join(f'{budget:g}' for budget in budgets)} s of processor time (fewer where "
            "the preset's updates are done earlier), evaluations and compiling not counted; "
            "critics are not fitted to returns meanwhile. So both are shorter than default runs.",
            "A return is that of the noise-free actor with the best imagined return of the run, "
            "a mean over training seeds ± half the 95 % interval over them (Student's t). A "
            f"policy is good at {100 * _GOOD:.0f} % of the way from the first actors' imagined "
            "return to the best that any run of the task reached. Times are medians over "
            "the seeds that got there. An update is one of the critics, with its share of the "
            "actor's and of imagination.",
            markdown_table(head, rows),
            f"Training seeds: {', '.join(map(str, seeds))}. Commits: {', '.join(commits)}. "
            f"Machines: {'; '.join(machines)}, shared with other work. The settings of each run "
            "are in its file.",
        ]
    )
    (results / "README.md").write_text(f"{text}\n")


def _row(task: str, method: str, runs: Sequence[dict[str, Any]], level: float) -> list[str]:
    last = [run["points"][-1] for run in runs]
    cost = statistics.median(1000 * point["seconds"] / point["updates"] for point in last)
    times = [seconds for run in runs if (seconds := good_after(run, level)) is not None]
    limited = [point["limited_share"] for run in runs for point in run["points"][1:]
               if "limited_share" in point]  # fmt: skip
    return [
        task,
        method,
        str(len(runs)),
        f"{cost:.1f}",
        f"{statistics.median(point['updates'] for point in last):.0f}",
        mean_and_half([best(run)["imagined"] for run in runs]),
        mean_and_half([best(run)["real"] for run in runs]),
        f"{statistics.median(times):.0f} ({len(times)} of {len(runs)})" if times else "none",
        f"{100 * statistics.mean(limited):.1f} %" if limited else "",
    ]


def main(run: Callable[..., dict[str, Any]] = train) -> None:
    """Train what is missing, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101, 102])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of processor time")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    logging.basicConfig(level=logging.WARNING)
    arguments.results.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:  # every seed is whole before the next begins
        for task in arguments.tasks:
            for method in arguments.methods:
                path = arguments.results / f"{task}-{method}-seed{seed}.json"
                if path.is_file():
                    kept = json.loads(path.read_text())
                    if (kept["settings"], kept["budget"]) != (
                        settings(method, seed),
                        arguments.budget,
                    ):
                        parser.error(f"{path}: made with other settings; give another --results.")
                    continue
                result = run(task, method, seed, arguments.budget)
                path.write_text(json.dumps(result, indent=1) + "\n")
                write_tables(arguments.results, TASKS)
                found = best(result)
                print(
                    f"{path}: imagined {found['imagined']:.1f}, real {found['real']:.1f}, "
                    f"{result['points'][-1]['updates']:.0f} updates",
                    flush=True,
                )
    write_tables(arguments.results, TASKS)


if __name__ == "__main__":
    main()
