"""What calibration in imagination chooses for the shipped agents, and what it is worth.

    python benchmarks/paper/calibration.py --tasks pendulum cartpole
    python benchmarks/paper/calibration.py --only-imagine     # without evaluation episodes
    python benchmarks/paper/calibration.py --keep             # play only what is new
    python benchmarks/paper/calibration.py --episodes 10      # fewer evaluation episodes
    python benchmarks/paper/calibration.py --only-write       # the table of what there is

Reads the agents in results/agents. The choice is made in imagination from seed 0, by the defaults
of the section ``calibrate``. Afterwards, to report only, the planner as given, the one chosen and
the actor play paired evaluation episodes. With ``--keep`` those that were played before by the same
agent with the same settings are not played again: a plan draws the same noise in them. Writes
results/calibration/{task}.json and README.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from measures import paired_difference
from phihp_torchrl import load_agent
from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation import EVALUATION_SEED, TARGETS, evaluate, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import CalibrateConfig, CalibratePhase

AGENTS, RESULTS = Path("results/agents"), Path("results/calibration")
SEED = 0  # of training: the choice must not see an evaluation seed
EPISODES = 20


def calibrated(agent: Agent) -> dict[str, Any]:
    """The record of a calibration, and its seconds of CPU."""
    start = time.process_time()
    phase = CalibratePhase(agent, CalibrateConfig(enabled=True), seed=SEED)
    while not phase.done:
        phase.advance()
    return {**phase.final, "cpu_seconds": time.process_time() - start}


def played(
    agent: Agent, changes: dict[str, Any], kept: Mapping[str, Any], episodes: int
) -> dict[str, Any]:
    """Returns and chatter of the planner as given, with ``changes`` and of the actor.

    Args:
        agent: the agent.
        changes: what calibration has changed.
        kept: episodes that were played before, by who acts.
        episodes: number of episodes.
    """
    assert agent.planner_config is not None
    ways = {"given": agent.planner_config, "chosen": replace(agent.planner_config, **changes)}
    results: dict[str, Any] = {}
    for name, config in {**ways, "actor": None}.items():
        if name == "chosen" and not changes:
            results[name] = results["given"]
            continue
        if name in kept:
            results[name] = kept[name]
            continue
        acting = agent.with_planner(config)
        found = evaluate(acting, agent.task, episodes=episodes, seed=EVALUATION_SEED)
        assert found.chatter is not None  # the simulated world measures it
        results[name] = {
            "returns": found.returns.tolist(),
            "chatter": found.chatter.mean().item(),
        }
    return results


def kept_episodes(path: Path, found: Mapping[str, Any]) -> dict[str, Any]:
    """Those in the file of a task that need not be played again for what was found anew."""
    before = json.loads(path.read_text()) if path.is_file() else {}
    world = dict(before.get("world", {}))
    if before.get("changes") != found["changes"]:
        world.pop("chosen", None)
    return world


def acting(found: dict[str, Any]) -> str:
    """Whose episodes are those of the calibrated agent, ``"chosen"`` or ``"actor"``."""
    return "actor" if found["acting"] == "actor" else "chosen"


def difference(world: dict[str, Any], ours: str, theirs: str) -> str:
    """Mean and standard error of paired differences, in words."""
    gap = paired_difference(*(torch.tensor(world[name]["returns"]) for name in (ours, theirs)))
    return f"{gap.mean:+.2f} ± {gap.standard_error:.2f}"


def changes_text(changes: dict[str, Any]) -> str:
    """Settings as one writes them."""
    return ", ".join(f"{key}={value}" for key, value in changes.items()) or "as given"


def gain_text(found: Mapping[str, Any]) -> str:
    """A gain over the actor and its standard error, in words."""
    return f"{found['gain']:+.2f} ± {found['gain_error']:.2f}"


def rows(results: dict[str, dict[str, Any]]) -> tuple[list[list[str]], list[list[str]]]:
    """The rows of both tables."""
    imagined, real = [], []
    for task, found in results.items():
        imagined.append(
            [
                task,
                found["acting"] + ("" if found["certain"] else ", in doubt"),
                f"{found['way']}: {changes_text(found['changes'])}",
                str(found["episodes"]),
                gain_text(found),
                *(f"{found[f'{who}_chatter']:.3f}" for who in ("planner", "actor")),
                "; ".join(f"{name} {gain_text(way)}" for name, way in found["ways"].items()),
                f"{found['cpu_seconds']:.0f}",
            ]
        )
        if world := found.get("world"):
            ways = ("given", "chosen", "actor")
            means = [sum(world[way]["returns"]) / len(world[way]["returns"]) for way in ways]
            real.append(
                [
                    task,
                    str(len(world["given"]["returns"])),
                    *(f"{mean:.1f}" for mean in means),
                    difference(world, acting(found), "given"),
                    difference(world, "chosen", "actor"),
                    *(f"{world[way]['chatter']:.3f}" for way in ways),
                ]
            )
    return imagined, real


def write(results: dict[str, dict[str, Any]], not_run: Iterable[str]) -> None:
    """The tables of all tasks done so far."""
    imagined, real = rows(results)
    first = ["task", "acts", "settings", "episodes", "gain over the actor"]
    first += ["chatter", "of the actor", "all ways", "CPU s"]
    second = ["task", "episodes", "as given", "chosen", "actor", "calibrated less as given"]
    second += ["chosen less actor", "chatter as given", "chosen", "actor"]
    left = ", ".join(not_run)
    origins = "; ".join(f"{task}, {found['origin']}" for task, found in results.items())
    text = (
        "# Calibration in imagination\n\nMade by `python benchmarks/paper/calibration.py`. "
        "Means ± standard errors of paired differences; chatter in units of the half-range.\n\n"
        f"## The choice, imagined\n\n{markdown_table(first, imagined)}\n"
        "CPU seconds are of one thread on a shared machine, so they are upper bounds.\n"
    )
    if real:
        text += (
            "\n## In the simulated world\n\nEvaluation episodes from seed "
            f"{EVALUATION_SEED:,}, to report only. Calibrated is whoever acts by the choice.\n\n"
            f"{markdown_table(second, real)}"
        )
    unplayed = ", ".join(task for task, found in results.items() if "world" not in found)
    text += f"\nNot played in the simulated world: {unplayed}.\n" if unplayed else ""
    text += f"\nNot run: {left}.\n" if left else ""
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "README.md").write_text(f"{text}\nMade at: {origins}.\n")


def write_all() -> None:
    """The tables of what is in the directory."""
    files = {task: RESULTS / f"{task}.json" for task in TARGETS}
    done = {task: json.loads(path.read_text()) for task, path in files.items() if path.is_file()}
    write(done, [task for task in TARGETS if task not in done])


@torch.no_grad()
def main() -> None:
    """Calibrate, play and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--only-imagine", action="store_true", help="play no evaluation episode")
    parser.add_argument("--keep", action="store_true", help="play only what was not played before")
    parser.add_argument("--only-write", action="store_true", help="write the table alone")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="evaluation episodes")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    for task in [] if arguments.only_write else arguments.tasks:
        agent, path = load_agent(AGENTS / task, planner=True), RESULTS / f"{task}.json"
        found = calibrated(agent)
        found["origin"] = origin_text(describe_origin(SEED))
        print(task, json.dumps(found), flush=True)  # playing may take long
        if not arguments.only_imagine:
            kept = kept_episodes(path, found) if arguments.keep else {}
            found["world"] = played(agent, found["changes"], kept, arguments.episodes)
        path.write_text(json.dumps(found, indent=1) + "\n")
        write_all()
    if arguments.only_write:
        write_all()


if __name__ == "__main__":
    main()
