"""What an ensemble of residuals and drawn constants gain and cost with a tenth of the samples.

    python benchmarks/paper/uncertainty.py --tasks pendulum-swingup --seeds 100 101 102

Trains PhIHP as the default preset does, but from a tenth of its real steps, in four variants:
plain, an ensemble of five residuals, constants drawn from the interval that the fit leaves them,
and both.
Writes results/uncertainty/<task>-<variant>-seed<seed>.json after every run, and a README.md beside
them. Runs that are there already are not repeated, so an interrupted command is simply given again.
Settings are chosen with seeds below 100 (and --results elsewhere), and reported with others.
Tasks with wide networks take hours so: `--narrow --updates 12000` learns with 2 x 128 and 3 x 128
units and less long, which the table says, for a gain is between variants alike in both.
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

import numpy as np

from measures import DEFAULT_SAMPLES, last_metrics, mean_and_half
from phihp_torchrl import learn, load_config
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.trainers import read_run_config

RESULTS = Path("results/uncertainty")
TASKS = (
    "pendulum-swingup",
    "cartpole-swingup",
    "pendulum",
    "cartpole",
    "acrobot",
    "acrobot-swingup",
)
PLAIN = "plain"
VARIANTS: dict[str, tuple[str, ...]] = {
    PLAIN: (),
    "ensemble": ("model.ensemble=5",),
    "constants": ("policy.draw_constants=true",),
    "both": ("model.ensemble=5", "policy.draw_constants=true"),
}
NARROW = (
    "policy.td3.actor_hidden_sizes=[128,128]",
    "policy.td3.critic_hidden_sizes=[128,128,128]",
    "policy.td3.actor_learning_rate=0.001",
    "policy.td3.critic_learning_rate=0.002",
)


def settings(
    task: str, variant: str, seed: int, updates: int | None, more: Sequence[str] = ()
) -> list[str]:
    """The settings of a run, as on a command line of ``phihp train``."""
    default = read_run_config(load_config(task)).section("policy").updates
    return [
        f"seed={seed}",
        f"model.real_steps={DEFAULT_SAMPLES[task] // 10}",
        f"policy.updates={min(updates or default, default)}",
        "policy.real_evaluation_episodes=0",
        "budget=fast",
        "evaluate.latency_actions=0",
        "evaluate.video=false",
        "progress=false",
        *VARIANTS[variant],
        *more,
    ]


_LOGGED = ("model/held_out_error", "model/rollout_error_20", "policy/best_imagined_return")


def train(task: str, variant: str, seed: int, lines: Sequence[str]) -> dict[str, Any]:
    """One run, from the first real step to the returns of evaluation."""
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        _, path = learn(task, overrides=lines, run_dir=Path(place, "run"))
        returns = json.loads((path / "evaluation.json").read_text())
        metadata = json.loads((path / "metadata.json").read_text())
        rows = list(csv.DictReader((path / "metrics.csv").open()))
    acting = "planner" if "planner" in returns else "actor"  # by calibration
    return {
        "task": task,
        "variant": variant,
        "seed": seed,
        "settings": list(lines),
        "real_steps": metadata["real_steps"],
        "acting": acting,
        "returns": {"planner": returns[acting]["returns"], "actor": returns["actor"]["returns"]},
        "metrics": last_metrics(rows, _LOGGED),
        "cost": cost(rows),
        "seconds": metadata["seconds"],
        "wall_seconds": round(time.monotonic() - begun, 1),
        "origin": describe_origin(seed),
    }


def cost(rows: Sequence[Mapping[str, str]]) -> dict[str, float]:
    """Seconds of all fits, and of an update with its share of imagination and evaluation.

    The latter is the median over evaluation intervals: the first, which compiles, does not count.
    """
    fits = sum(float(row["model/fit_seconds"]) for row in rows if row.get("model/fit_seconds"))
    points = [
        (float(row["policy/seconds"]), float(row["policy/updates"]))
        for row in rows
        if row.get("policy/seconds")
    ]
    pairs = zip(points[1:], points[:-1], strict=True)
    each = [(after[0] - before[0]) / (after[1] - before[1]) for after, before in pairs]
    return {"fits": fits, **({"update": float(np.median(each))} if each else {})}


def gains(runs: Sequence[Mapping[str, Any]], player: str) -> list[list[str]]:
    """A row for each task and variant: returns, and gain and cost against plain by seed."""
    rows = []
    by_key = {(r["task"], r["variant"], r["seed"]): r for r in runs if player in r["returns"]}
    for task in TASKS:
        for variant in VARIANTS:
            seeds = [s for t, v, s in sorted(by_key) if (t, v) == (task, variant)]
            mine = {s: by_key[task, variant, s] for s in seeds}
            if not mine:
                continue
            means = {s: float(np.mean(run["returns"][player])) for s, run in mine.items()}
            plain = {s: by_key[task, PLAIN, s] for s in seeds if (task, PLAIN, s) in by_key}
            gain = [means[s] - float(np.mean(plain[s]["returns"][player])) for s in plain]
            rows.append(
                [
                    task,
                    variant,
                    str(len(seeds)),
                    str(mine[seeds[0]]["real_steps"]),
                    str(_value_of(mine[seeds[0]], "policy.updates")),
                    "narrow" if set(NARROW) <= set(mine[seeds[0]]["settings"]) else "default",
                    mean_and_half(list(means.values())),
                    "" if variant == PLAIN or not gain else mean_and_half(gain),
                    *(_times(mine, plain, part) for part in ("fits", "update")),
                ]
            )
    return rows


def _times(
    mine: Mapping[int, Mapping[str, Any]], plain: Mapping[int, Mapping[str, Any]], part: str
) -> str:
    """How many times longer than plain a part takes: the median over seeds that recorded it."""
    ratios = [
        mine[s]["cost"][part] / plain[s]["cost"][part]
        for s in plain
        if mine[s] is not plain[s] and all(part in r.get("cost", {}) for r in (mine[s], plain[s]))
    ]
    return f"{np.median(ratios):.2f}" if ratios else ""


def _value_of(run: Mapping[str, Any], key: str) -> str:
    return next(line.split("=", 1)[1] for line in run["settings"] if line.startswith(f"{key}="))


def write_tables(results: Path) -> None:
    """The tables of all runs so far."""
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    header = ["task", "variant", "seeds", "real samples", "updates", "networks", "return"]
    header += ["gain over plain", "fits, × plain's time", "an update, × plain's time"]
    text = (
        "# Uncertainty in imagination\n\n"
        "Made by `python benchmarks/paper/uncertainty.py`. Do not edit. PhIHP with a tenth of the "
        "default preset's real steps, `budget=fast` for the planner, and at most as many updates "
        "of the policy as the column says. Narrow networks: `"
        + " ".join(NARROW)
        + "`. Variants: "
        + "; ".join(f"{name}: {_changes(lines)}" for name, lines in VARIANTS.items())
        + ".\n\nReturns are means over 50 evaluation episodes of a training seed, then over "
        "training seeds, ± half the 95 % interval over training seeds (Student's t). A gain is "
        "taken seed by seed, over the same episodes. An interval that holds 0 shows no gain. "
        "Where calibration leaves acting to the actor, the agent is shipped as that. Times are "
        "wall clock on a machine shared with other work, medians over seeds, without what "
        "compiling takes.\n"
    )
    for player, title in (("planner", "The agent as it is shipped"), ("actor", "The actor alone")):
        text += f"\n## {title}\n\n{markdown_table(header, gains(runs, player))}"
    commits = sorted({commit_text(run["origin"]) for run in runs})
    machines = sorted({machine_text(run["origin"]) for run in runs})
    seeds = sorted({run["seed"] for run in runs})
    text += (
        f"\nTraining seeds: {', '.join(map(str, seeds))}. Commits: {', '.join(commits)}. "
        f"Machines: {'; '.join(machines)}. The settings of each run are in its file.\n"
    )
    (results / "README.md").write_text(text)


def _changes(lines: Sequence[str]) -> str:
    return f"`{' '.join(lines)}`" if lines else "neither"


def main() -> None:
    """Train what is missing, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101, 102])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--updates", type=int, help="most updates of the policy")
    parser.add_argument("--narrow", action="store_true", help="networks that are quick to train")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    arguments.results.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:  # every seed is whole before the next begins
        for task in arguments.tasks:
            for variant in arguments.variants:
                path = arguments.results / f"{task}-{variant}-seed{seed}.json"
                more = NARROW if arguments.narrow else ()
                lines = settings(task, variant, seed, arguments.updates, more)
                if path.is_file():
                    if json.loads(path.read_text())["settings"] != lines:
                        parser.error(f"{path}: made with other settings; give another --results.")
                    continue
                result = train(task, variant, seed, lines)
                path.write_text(json.dumps(result, indent=1) + "\n")
                write_tables(arguments.results)
                found = {name: np.mean(values) for name, values in result["returns"].items()}
                print(f"{path}: {found}, {result['seconds']}", flush=True)
    write_tables(arguments.results)


if __name__ == "__main__":
    main()
