"""Milliseconds for an action of every way to act that the paper compares, eager and compiled.

    python benchmarks/paper/latency.py
    python benchmarks/paper/latency.py --tasks acrobot --eager

The time of an action depends on sizes and not on weights, so that nothing is trained: networks and
models are those of each method's settings, untrained. All ways take turns in one process, ten
actions each, which is a whole number of plans for those that replan every few steps; what stands is
the mean of a turn, in the median over turns. PhIHP's default plan may have been calibrated to a
cheaper one in a run, which has a time of its own in ``evaluation.json``. Times are those of the one
thread, without what it waited for. Writes results/latency, where tasks that are not measured stay.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, load_config, make_world
from phihp_torchrl.agents import TD3Config, make_actor, make_twin_qvalue
from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.evaluation import PUBLISHED, TARGETS, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.tdmpc import TOLD, TDMPCAgent
from phihp_torchrl.trainers import make_dynamics, read_run_config

RESULTS = Path("results/latency")
TURNS, IN_A_TURN = 15, 10
WAYS = {
    "PhIHP": ("phihp", "default"),
    "PhIHP, published": ("phihp", "paper"),
    "CEM-oracle": ("cem-oracle", "paper"),
    "TD-MPC, published": ("td-mpc", "paper"),
    "TD-MPC, reduced": ("td-mpc", "default"),
    "TD3": ("td3", "paper"),
}
"""Method and preset of each way to act."""
_PAPERS = ("PhIHP", "TD-MPC", "TD3", "CEM-oracle")
"""Those of which the paper has a time."""


def untrained(task: str, method: str, preset: str, *, compile: bool) -> Agent:
    """An agent of the method's sizes, which plans as its runs do."""
    config = read_run_config(load_config(task, method=method, preset=preset))
    world = make_world(task)
    if method == "td-mpc":
        section = config.section("tdmpc")
        told = TOLD.for_task(world.task, section.learn.told)
        return TDMPCAgent(world.task, told, section.planner.at(section.real_steps), compile=compile)
    parts: dict[str, Any] = {}
    if "model" in config.sections:
        generator = torch.Generator().manual_seed(0)
        parts["dynamics"] = make_dynamics(world, config.section("model"), generator)
    td3 = getattr(config.sections.get("policy"), "td3", config.sections.get("td3"))
    if isinstance(td3, TD3Config):
        td3 = resolve_seconds(td3, world.task.time_step)
        parts["actor"] = make_actor(world.task, td3.actor_hidden_sizes)
        parts["qvalue"] = make_twin_qvalue(world.task, td3.critic_hidden_sizes)
    return Agent(world.task, **parts, planner_config=config.planner, compile=compile)


def turn(agent: Agent, observations: list[torch.Tensor]) -> float:
    """Milliseconds for an action, the mean of a turn that begins with a plan."""
    agent.reset()
    start = time.thread_time()
    for i, observation in enumerate(observations):
        agent(TensorDict(observation=observation, is_init=torch.tensor([i == 0])))
    return 1e3 * (time.thread_time() - start) / len(observations)


def measure(task: str, *, compiled: bool) -> dict[str, Any]:
    """The time of an action of each way to act on a task."""
    agents: dict[str, Agent] = {}
    for name, (method, preset) in WAYS.items():
        for fast in (False, True) if compiled else (False,):
            agent = untrained(task, method, preset, compile=fast)
            if fast and agent.planner is None:  # nothing of an actor alone is compiled
                continue
            agents[f"{name}, {'compiled' if fast else 'eager'}"] = agent
    some = next(iter(agents.values())).task
    states = some.sample_start([IN_A_TURN], torch.Generator().manual_seed(0))
    observations = list(some.observe(states))
    times: dict[str, list[float]] = {name: [] for name in agents}
    for name, agent in agents.items():
        turn(agent, observations)  # compiles
        print(task, name, flush=True)
    for _ in range(TURNS):
        for name, agent in agents.items():
            times[name].append(turn(agent, observations))
    return {
        "milliseconds": {name: median(of) for name, of in times.items()},
        "turns": times,
        "search": load_config(task)["planner"],  # of PhIHP by default, by which a test sees its age
        "origin": describe_origin(0),
    }


def write_table(results: Path) -> None:
    """A row for each task, a column for each way to act."""
    found = {
        task: json.loads(path.read_text())
        for task in TARGETS
        if (path := results / f"{task}.json").is_file()
    }
    columns = list(dict.fromkeys(name for one in found.values() for name in one["milliseconds"]))
    rows = []
    for task, one in found.items():
        times = one["milliseconds"]
        cells = [f"{times[name]:.2f}" if name in times else "–" for name in columns]
        paper = PUBLISHED.get(task, {})
        said = [f"{paper[name].milliseconds:g}" if name in paper else "–" for name in _PAPERS]
        rows.append([task, *cells, " / ".join(said)])
    header = ["task", *columns, f"published: {' / '.join(_PAPERS)}"]
    origins = "; ".join(sorted({origin_text(one["origin"]) for one in found.values()}))
    (results / "README.md").write_text(
        "# Milliseconds for an action\n\nMade by `python benchmarks/paper/latency.py`. Do not "
        f"edit. Untrained agents of each method's sizes take turns of {IN_A_TURN} actions; what "
        f"stands is the mean of a turn, in the median of {TURNS}. Times are those of one thread. "
        "CEM-oracle's plan serves five actions. Published times are of an Apple M1."
        f"\n\n{markdown_table(header, rows)}\n\n{origins}.\n"
    )


def main() -> None:
    """Measure the tasks, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--eager", action="store_true", help="without compiled plans")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    options.results.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    for task in options.tasks:
        with torch.no_grad():
            found = measure(task, compiled=not options.eager)
        (options.results / f"{task}.json").write_text(json.dumps(found, indent=1) + "\n")
        write_table(options.results)


if __name__ == "__main__":
    main()
