"""A motor's speed on a random reference: agents beside PI controllers and regulators.

    python benchmarks/paper/tracking.py --seeds 100 101
    python benchmarks/paper/tracking.py --seeds 100 101 --only-calibrated

Learns ``rigs/motor.py`` for each seed and each preview, from real steps of its simulated world. A
PI controller, with a clamped integral, and an LQR with integral action, of that world's own
equations, are tuned in that same world on an episode seed below 100: each once for the least RMS
error and once for the highest return, which counts small errors more. Beside each agent plays an
LQR as evaluations have it too, built in the agent's learned model and not tuned, and the agent as
calibration leaves it today, with a regulator on a reference that stands still. With
``--only-calibrated`` that one alone plays, and the results of others stay. All are then
measured on episodes from 1,000,000 on: in the world as it is, with a constant torque of the load,
and with another inertia, none of which anybody is told. Writes results/tracking/.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl import Agent, get_task, learn, load_agent, load_config, save_agent
from phihp_torchrl.baselines import LQI
from phihp_torchrl.config import read_kind, resolve_seconds
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.planners import PLANNERS
from phihp_torchrl.trainers import CalibrateConfig, CalibratePhase, import_plugins
from tracking_episodes import TASKS, measure
from tuned_controllers import CRITERIA, LQR, TUNABLE, tune

RIGS = Path(__file__).parent / "rigs"
RESULTS, AGENTS = Path("results/tracking"), Path("outputs/tracking")
SETTINGS = {
    "model.real_steps": 1000,
    "model.steps_per_iteration": 500,
    "policy.evaluation_steps": 250,
    "policy.strategies": "none",
    "policy.real_evaluation_episodes": 0,
    "evaluate.episodes": 2,
    "evaluate.latency_actions": 0,
    "evaluate.video": False,
    "progress": False,
    "compile": False,
}
"""What differs from the defaults: a small budget, one way to learn, and no pictures."""

SETTLED: dict[str, Any] = {
    "warm_start": True,
    "keep_incumbent": True,
    "num_kept_elites": 2,
    "init_std": 0.3,
}
"""A search that settles: it goes on from its last plan, which it keeps unless another is better.

Chosen by ``tracking_search.py`` with episodes of a training seed."""


def train(name: str, seed: int, updates: int, place: Path, models: Path | None = None) -> Agent:
    """The agent in ``place``, which is learned with the settings above if it is not there.

    Args:
        name: the task.
        seed: of training.
        updates: of the critics.
        place: where agents are kept.
        models: where there are runs that have done the phase model, ``{task}-{seed}``; for
            ``None`` the model is learned too.
    """
    directory = place / f"{name}-{seed}-{updates}"
    if not directory.exists():
        settings = {**SETTINGS, "seed": seed, "policy.updates": updates}
        if models is not None:
            settings |= {"from": f"{models / f'{name}-{seed}'}"}
            settings |= {"phases": ["policy", "calibrate", "evaluate"]}
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as run:
            agent = learn(name, overrides=settings, run_dir=f"{run}/run").agent
        agent.metadata |= {"seconds": time.perf_counter() - begun, "tracking": SETTINGS}
        save_agent(agent, directory)
    kept = load_agent(directory, task=get_task(name))
    if kept.metadata.get("tracking") != SETTINGS:
        raise ValueError(f"{directory}: learned with other settings; remove it to learn again.")
    return kept


def calibrated(agent: Agent, seed: int) -> Agent:
    """The agent as calibration leaves it, from the settings of the planner that it is given."""
    task, given = agent.task, load_config(agent.task.name)
    config = resolve_seconds(read_kind(PLANNERS, given["planner"], "planner"), task.time_step)
    parts = {name: getattr(agent, name) for name in ("dynamics", "actor", "qvalue")}
    phase = CalibratePhase(
        Agent(task, **parts, planner_config=config), CalibrateConfig(), seed=seed
    )
    while not phase.done:
        phase.advance()
    return Agent(task, **parts, **phase.parts())


def write(result: Mapping[str, Any], results: Path) -> None:
    """Write the result of a task and seed, and the table of all so far."""
    name = f"{result['task']}-{result['seed']}" if result["seed"] is not None else result["task"]
    name += result.get("part", "")
    results.mkdir(parents=True, exist_ok=True)
    (results / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    every = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    rows = [
        [r["task"], controller, world, *(f"{m[key]:.3g}" for key in
         ("rms", "steady_error", "steady_error_largest", "steady_ripple"))]
        for r in every
        for controller, worlds in r["measured"].items()
        for world, m in worlds.items()
    ]  # fmt: skip
    head = ["task", "controller", "world", "RMS error", "steady error", "its largest", "ripple"]
    commits = sorted({commit_text(r["origin"]) for r in every})
    machines = sorted({machine_text(r["origin"]) for r in every})
    gains = "; ".join(
        f"{name}: {', '.join(f'{number} = {value:.3g}' for number, value in found.items())}"
        for r in every
        for name, found in r.get("gains", {}).items()
    )
    (results / "README.md").write_text(
        "# A motor's speed on a random reference\n\n"
        "Made by `python benchmarks/paper/tracking.py`. Do not edit. All errors are in rad/s, of "
        f"{every[0]['episodes']} episodes of evaluation. The RMS error is of random references of "
        "steps, ramps and sines. Steady errors are of constant references: the mean error of the "
        "last second, its size on average and at most over the episodes; the ripple is the "
        f"standard deviation within that second. Controllers with a criterion in their names "
        f"are tuned by it in the world as it is ({gains}), an LQR of that world's own equations; "
        "one with a seed is built in the learned model of that agent, and not tuned. *Agent as "
        "calibrated* is the agent as calibration leaves it, with a regulator where a reference "
        "stands still if imagined episodes say so; *planner* are its plans alone. Nobody is "
        "told of other worlds. *motor-preview* knows the reference of the next five steps, which "
        "PI controllers and LQR have no use for.\n\n"
        f"{markdown_table(head, rows)}\n"
        f"Commits: {', '.join(commits)}. Machines: {'; '.join(machines)}, shared with other work.\n"
    )
    for row in rows:
        if row[0] == result["task"]:
            print(*row, sep=" | ", flush=True)


def measure_controllers(episodes: int, tries: int, results: Path) -> None:
    """Tune what needs no agent in the true world, measure it, and write."""
    task = get_task("motor")
    gains = {
        f"{name}, {by}": tune(kind, task, episodes, criterion, tries)
        for name, kind in TUNABLE.items()
        for by, criterion in CRITERIA.items()
    }
    measured = {
        name: measure(TUNABLE[name.split(", ")[0]].make(task, *found.values()), task, episodes)
        for name, found in gains.items()
    }
    result = {
        "task": "motor",
        "seed": None,
        "gains": gains,
        "episodes": episodes,
        "measured": measured,
        "origin": describe_origin(0),
    }
    write(result, results)


def measure_agent(agent: Agent, seed: int, episodes: int) -> dict[str, Any]:
    """What the agent as it was saved, its parts and an LQR in its model do in each world."""
    task, config = agent.task, agent.planner_config
    assert config is not None
    assert agent.dynamics is not None
    plans = {
        "planner": agent.with_planner(config),
        "planner that settles": agent.with_planner(replace(config, **SETTLED)),
    }
    for each in plans.values():
        each.catch = None  # a regulator that calibration chose is played beside them
    acting: dict[str, Any] = {
        **plans,
        "actor": agent.actor_alone(),
        LQR: LQI.from_model(task, agent.dynamics),
    }
    return {f"{name}, seed {seed}": measure(each, task, episodes) for name, each in acting.items()}


def main(words: Sequence[str] | None = None) -> None:
    """Tune, learn, measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[100])
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=list(TASKS))
    parser.add_argument("--updates", type=int, default=2500)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--tries", type=int, default=30, help="plays of a tuning, from each start")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--agents", type=Path, default=AGENTS, help="where agents are kept")
    parser.add_argument("--models", type=Path, help="runs that have done the phase model")
    parser.add_argument("--only-calibrated", action="store_true")
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    import_plugins([f"{RIGS / 'motor.py'}"])
    episodes = arguments.episodes
    if not arguments.only_calibrated:
        measure_controllers(episodes, arguments.tries, arguments.results)
    for seed in arguments.seeds:
        for name in arguments.tasks:
            agent = train(name, seed, arguments.updates, arguments.agents, arguments.models)
            common = {
                "task": name,
                "seed": seed,
                "seconds": agent.metadata["seconds"],
                "updates": arguments.updates,
                "settings": SETTINGS,
                "episodes": episodes,
                "origin": describe_origin(seed),
            }
            if not arguments.only_calibrated:
                measured = measure_agent(agent, seed, episodes)
                chosen = agent.metadata.get("calibration")
                parts = {"settled": SETTLED, "calibration": chosen, "measured": measured}
                write({**common, **parts}, arguments.results)
            ours = calibrated(agent, seed)
            measured = {f"agent as calibrated, seed {seed}": measure(ours, agent.task, episodes)}
            chosen = ours.metadata["calibration"]
            parts = {"part": "-calibrated", "calibration": chosen, "measured": measured}
            write({**common, **parts}, arguments.results)


if __name__ == "__main__":
    main()
