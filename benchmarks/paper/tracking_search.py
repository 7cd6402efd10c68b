"""How near a reference a plan stays, by how it searches: the motor, its true model, no policy.

    python benchmarks/paper/tracking_search.py

``tracking.py`` measures whole agents. Here the model is the world itself and nothing is learned, so
that what is left of an error is the search's own. Each row changes the planner's defaults. Episodes
have a training seed, for settings are chosen from this. Writes results/tracking_search/; what is
there already is not played again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl import Agent, get_task
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import import_plugins
from phihp_torchrl.worlds import SimulatedWorld
from tracking import RIGS
from tracking_episodes import play, rms
from tuned_controllers import PI

RESULTS, TUNED = Path("results/tracking_search"), Path("results/tracking/motor.json")
SEED, STEPS = 1, 75
_WARM = {"warm_start": True}
_KEPT = {**_WARM, "keep_incumbent": True, "num_kept_elites": 2}
SEARCHES: dict[str, Mapping[str, Any]] = {
    "defaults": {},
    "warm_start": _WARM,
    "warm_start, init_std 0.3": {**_WARM, "init_std": 0.3},
    "keep_incumbent": _KEPT,
    "keep_incumbent, init_std 0.3": {**_KEPT, "init_std": 0.3},
    "keep_incumbent, init_std 0.1": {**_KEPT, "init_std": 0.1},
}
"""What differs from the planner's defaults."""
MOVING = "keep_incumbent, init_std 0.3"
"""The search that follows moving references too, with and without a preview."""


def planner(name: str, changes: Mapping[str, Any]) -> Agent:
    """An agent that plans in the true model, without a policy and a value."""
    alone = {"num_policy_candidates": 0, "compare_with_actor": False, "alpha": 0.0}
    dynamics = SimulatedWorld(name).oracle()
    return Agent(
        get_task(name), dynamics=dynamics, planner_config=CEMConfig(**{**alone, **changes})
    )


def still(changes: Mapping[str, Any], episodes: int) -> dict[str, float]:
    """Steady errors on constant references, of the last third of the steps."""
    task = get_task("motor")
    speeds, references = play(
        planner("motor", changes),
        task,
        {},
        episodes=episodes,
        seed=SEED,
        steps=STEPS,
        constant=True,
    )
    last = (speeds - references)[-STEPS // 3 :]
    return {
        "steady_error": last.mean(0).abs().mean().item(),
        "steady_error_largest": last.mean(0).abs().max().item(),
        "steady_ripple": last.std(0).mean().item(),
    }


def moving(name: str, episodes: int) -> float:
    """RMS error on random references."""
    agent = planner(name, SEARCHES[MOVING])
    return rms(*play(agent, agent.task, {}, episodes=episodes, seed=SEED))


def by_hand(gains: Mapping[str, float], episodes: int) -> float:
    """RMS error of a PI controller on the same references."""
    task = get_task("motor")
    return rms(*play(PI(task, **gains), task, {}, episodes=episodes, seed=SEED))


def write(found: dict[str, Any], results: Path) -> None:
    """Write everything as JSON, and a page."""
    results.mkdir(parents=True, exist_ok=True)
    found["origin"] = describe_origin(SEED)
    (results / "search.json").write_text(json.dumps(found, indent=1) + "\n")
    keys = ("steady_error", "steady_error_largest", "steady_ripple")
    rows = [[name, *(f"{m[key]:.3f}" for key in keys)] for name, m in found["still"].items()]
    table = markdown_table(["search", "steady error", "its largest", "ripple"], rows)
    lines = "".join(f"- {name}: {error:.2f}\n" for name, error in found["moving"].items())
    (results / "README.md").write_text(
        "# What of a tracking error is the search's own\n\n"
        "Made by `python benchmarks/paper/tracking_search.py`. Do not edit. A motor's speed, "
        "planned in the true model without a policy and a value, so nothing is learned wrongly and "
        f"no disturbance is there. Errors in rad/s, of {found['episodes']} episodes of training "
        f"seed {SEED}. Steady errors are of constant references, over the last third of {STEPS} "
        "steps.\n\n"
        f"{table}\nRMS errors on random references, of PI controllers (`tracking.py`) and of "
        f"plans ({MOVING}) without and with a preview of five steps:\n\n{lines}\n"
        f"Made at {origin_text(found['origin'])}.\n"
    )


def main(words: Sequence[str] | None = None) -> None:
    """Play, and write after each search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    import_plugins([f"{RIGS / 'motor.py'}"])
    path, episodes = arguments.results / "search.json", arguments.episodes
    found: dict[str, Any] = {"episodes": episodes, "still": {}, "moving": {}}
    found = json.loads(path.read_text()) if path.is_file() else found
    if found["episodes"] != episodes:
        raise ValueError(f"{path}: has {found['episodes']} episodes; remove it to play {episodes}.")
    for name, changes in SEARCHES.items():
        if name not in found["still"]:
            torch.manual_seed(SEED)
            found["still"][name] = still(changes, episodes)
            write(found, arguments.results)
    gains = json.loads(TUNED.read_text())["gains"]
    runs = {name: partial(by_hand, each, episodes) for name, each in gains.items()}
    runs |= {name: partial(moving, name, episodes) for name in ("motor", "motor-preview")}
    for name, run in runs.items():
        if name not in found["moving"]:
            torch.manual_seed(SEED)
            found["moving"][name] = run()
            write(found, arguments.results)


if __name__ == "__main__":
    main()
