"""A crane in newtons and kilograms, learned in its own units, beside LQR and PID.

    python benchmarks/paper/learn_crane.py --seed 100
    python benchmarks/paper/learn_crane.py --seed 100 --single --updates 2500

Learns ``rigs/heavy_crane.py``, whose forces are ±4000 N and whose masses are hundreds of kg, from
real steps of its simulated world with friction, with ``policy.scales=auto`` and a small budget. The
LQR and the PID are built in the model that was learned, and all are played in the same episodes of
evaluation. With ``--single`` the settings of the policy are kept even where they seem to fail in
imagination, and no other strategy is tried. Writes results/crane/.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from measures import last_metrics
from phihp_torchrl import learn
from phihp_torchrl.evaluation import BASELINES_KEY, controllers_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.trainers import import_plugins

RIG = Path(__file__).parent / "rigs/heavy_crane.py"
RESULTS = Path("results/crane")
SETTINGS = {
    "world.integrator": "rk4",
    "model.real_steps": 600,
    "model.steps_per_iteration": 300,
    "policy.scales": "auto",
    "policy.real_evaluation_episodes": 0,
    "policy.evaluation_interval": 500,
    "policy.td3.actor_hidden_sizes": [64, 64],
    "policy.td3.critic_hidden_sizes": [64, 64],
    "evaluate.baselines": ["lqr", "pid"],
    "evaluate.latency_actions": 0,
    "evaluate.video": False,
    "progress": False,
    "compile": False,
}
"""What differs from the defaults: a small budget, small networks, and no pictures."""
_LOGGED = ("model/held_out_error", "model/rollout_error_20", "policy/imagined_return")


def train(seed: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Learn the crane, and return what its evaluation says, by controller."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        overrides = {**settings, "seed": seed, "plugins": [str(RIG)]}
        path = learn("heavy-crane", overrides=overrides, run_dir=f"{place}/run").path
        played = json.loads((path / "evaluation.json").read_text())
        rows = csv.DictReader((path / "metrics.csv").read_text().splitlines())
        metrics = last_metrics(rows, _LOGGED)
    beside = played.pop(BASELINES_KEY, {})
    return {
        "seed": seed,
        "settings": dict(settings),
        "seconds": time.perf_counter() - begun,
        "metrics": metrics,
        "results": {**played, **beside},
        "origin": describe_origin(seed),
    }


def write(result: Mapping[str, Any], results: Path) -> None:
    """Write the result of a seed, and the page of all so far."""
    results.mkdir(parents=True, exist_ok=True)
    kind = "-single" if "policy.strategies" in result["settings"] else ""
    path = results / f"crane-{result['seed']}{kind}.json"
    path.write_text(json.dumps(result, indent=1) + "\n")
    text = [
        "# A crane in newtons and metres\n",
        "Made by `python benchmarks/paper/learn_crane.py`, which says what is learned. "
        "Do not edit. "
        "Returns are means over the same episodes with their standard errors, each of one trained "
        "agent; 0 is the most. LQR and PID know the agent's learned model, not the truth.\n",
    ]
    for path in sorted(results.glob("crane-*.json")):
        every = json.loads(path.read_text())
        count = len(next(iter(every["results"].values()))["returns"])
        single = "policy.strategies" in every["settings"]
        title = f"seed {every['seed']}, {'one strategy' if single else 'strategies'}"
        metrics = ", ".join(f"`{name}` {value:.3g}" for name, value in every["metrics"].items())
        text += [
            controllers_table(title, every["results"]),
            f"{count} episodes; {every['settings']['model.real_steps']} real steps, "
            f"{every['settings']['policy.updates']} updates a strategy at most, "
            f"{every['seconds']:.0f} s in all. At the end of training: {metrics}. "
            f"Made at commit {commit_text(every['origin'])}, "
            f"{machine_text(every['origin'])}, shared with other work.\n",
        ]
    (results / "README.md").write_text("\n".join(text))


def main(words: Sequence[str] | None = None) -> None:
    """Learn and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--single", action="store_true")
    parser.add_argument("--updates", type=int, default=2000)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    import_plugins([str(RIG)])
    settings: dict[str, Any] = {
        **SETTINGS,
        "policy.updates": arguments.updates,
        "evaluate.episodes": arguments.episodes,
    }
    if arguments.single:
        settings["policy.strategies"] = []
    write(train(arguments.seed, settings), arguments.results)


if __name__ == "__main__":
    main()
