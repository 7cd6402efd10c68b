"""What each departure of the default preset from the paper does, one taken back at a time.

    python benchmarks/paper/run_grid.py runs=outputs/base task=pendulum-swingup,acrobot
    python benchmarks/paper/run_grid.py runs=outputs/base task=cartpole-swingup
    python benchmarks/paper/departures.py --runs outputs/base

On the first of the tasks in which a setting departs, runs again what depends on it with the
published value: for a setting of the model, phase 1; for one of the policy, phase 2 in the model of
a finished run of the default preset; for one of the planner, the evaluation of that run's policy.
Writes results/departures/, from where ``docs/departures.py`` takes the measured effects; what is
there already is not measured again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import torch
import yaml

from measures import PUBLISHED_SAMPLES, paired_difference, prediction_errors
from model_error import model_config
from phihp_torchrl import load_config
from phihp_torchrl.config import flatten, override_lines
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import ModelTrainer
from phihp_torchrl.worlds import SimulatedWorld

RESULTS = Path("results/departures")
TASKS = ("pendulum-swingup", "acrobot", "cartpole-swingup")
PHASES = {"policy": "[policy,evaluate]", "planner": "[evaluate]"}
"""What runs again for a change in a section; for one of the model, a trainer without a run."""
ELSEWHERE = {"model.collect.exploration_reward": "cartpole-swingup"}
"""Settings that do nothing on the first task in which they depart."""
TOGETHER = {"model.fit.method": ("model.fit.steps", "model.warm_start")}
"""Settings that make sense only with others as published, too."""
LEFT_OUT = (
    "model.real_steps",  # results/README.md has a table of it
    "policy.updates",  # takes hours; preset=paper has it
    "policy.evaluation_interval",  # more than the default's updates in all, on some tasks
    "model.fit.steps",  # with model.fit.method
)
"""Settings that are not measured, or not alone."""
QUIET = ["progress=false", "evaluate.video=false", "evaluate.latency_actions=0"]
NOISE = "seed"
"""In the place of a key: the same settings with another seed, to compare the effects with."""


@cache
def settings(task: str, preset: str) -> dict[str, Any]:
    """Value of every key of a preset on a task."""
    return flatten(load_config(task, preset=preset))


def departures(task: str) -> dict[str, Any]:
    """The published value of every key to measure in which the default departs on a task."""
    paper, ours = settings(task, "paper"), settings(task, "default")
    return {
        key: paper[key]
        for key in ours
        if key.split(".")[0] in ("model", *PHASES)
        and key not in LEFT_OUT
        and paper[key] != ours[key]
        and ELSEWHERE.get(key, task) == task
    }


def changes(task: str, key: str) -> list[str]:
    """The words that set ``key``, and what belongs to it, to its published value."""
    paper = settings(task, "paper")
    return override_lines({name: paper[name] for name in (key, *TOGETHER.get(key, ()))})


@cache
def model_error(task: str, words: tuple[str, ...] = ()) -> float:
    """Median 20-step error, from the wide box, of a model of the default preset but for words."""
    torch.manual_seed(0)
    world = SimulatedWorld(task)
    trainer = ModelTrainer(world.task, model_config(task, *words), seed=0, world=world)
    while not trainer.done:
        trainer.advance()
    return prediction_errors(world, trainer.dynamics)["coverage_median"]


def rerun(task: str, section: str, words: list[str], base: Path, out: Path) -> dict[str, Any]:
    """What the words do to the returns of the run ``base``, over the same episodes."""
    steps = yaml.safe_load((base / "config.yaml").read_text())["model"]["real_steps"]
    command = [sys.executable, "-m", "phihp_torchrl", "train", f"task={task}", *words, *QUIET]
    command += [f"phases={PHASES[section]}", f"from={base}", f"run_dir={out}"]
    command += ["calibrate.enabled=false"]  # the planner's settings are those compared
    subprocess.run([*command, f"model.real_steps={steps}"], check=True)
    effects = {}
    for role in ("planner", "actor")[: 1 if section == "planner" else 2]:
        ours, theirs = (
            torch.tensor(json.loads((run / "evaluation.json").read_text())[role]["returns"])
            for run in (base, out)
        )
        paired = paired_difference(theirs, ours)
        effects[role] = {
            "default": ours.mean().item(),
            "difference": paired.mean,
            "standard_error": paired.standard_error,
        }
    return effects


def measure(task: str, key: str, base: Path, out: Path) -> dict[str, Any]:
    """The effect of the published value of ``key``, or of another seed."""
    if key == NOISE:
        return {"value": 1, **rerun(task, "policy", ["seed=1"], base, out)}
    section, value = key.split(".")[0], settings(task, "paper")[key]
    words = changes(task, key)
    if section != "model":
        return {"value": value, **rerun(task, section, words, base, out)}
    errors = {"error": model_error(task, tuple(words)), "default_error": model_error(task)}
    return {"value": value, **errors}


def describe(key: str, found: dict[str, Any]) -> str:
    """The effect of going back to the published value, in a line."""
    others = " and ".join(f"`{name}`" for name in TOGETHER.get(key, ()))
    others = f", with {others}" if others else ""
    if "error" in found:
        factor = found["error"] / found["default_error"]
        return f"{found['task']}: 20-step error × {factor:.2g}{others}"
    texts = [
        f"{role} {row['difference']:+.1f} ± {row['standard_error']:.1f}".replace("-", "−")
        for role in ("planner", "actor")
        if (row := found.get(role))
    ]
    return f"{found['task']}: {', '.join(texts)}{others}"


def write(entries: dict[str, dict[str, Any]]) -> None:
    """The effects, for ``docs/departures.py`` and for people."""
    for key, entry in entries.items():
        entry["effect"] = describe(key, entry)
    rows = [
        [f"`{key}`", str(entry["value"]), entry["effect"], entry.get("origin", "not recorded")]
        for key, entry in entries.items()
    ]
    (RESULTS / "departures.json").write_text(json.dumps(entries, indent=1) + "\n")
    (RESULTS / "README.md").write_text(
        "# What the departures do\n\nMade by `python benchmarks/paper/departures.py`: the default "
        "preset with one setting as published. Effects are published less default: of returns, "
        "over the same 50 episodes, one run each, with its standard error; or the factor on the "
        f"median 20-step error from the task's wide box. The row `{NOISE}` is the default preset's "
        "policy of another seed: smaller effects than its are not told from chance.\n\n"
        + markdown_table(["key", "value", "published less default", "made at"], rows)
    )


def main() -> None:
    """Measure what has not been measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, help="where the finished runs are")
    parser.add_argument("--tasks", nargs="+", choices=list(PUBLISHED_SAMPLES), default=list(TASKS))
    parser.add_argument("--out", type=Path, default=Path("outputs/departures"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / "departures.json"
    entries = json.loads(path.read_text()) if path.exists() else {}
    # Each key on the first task in which it departs, unless it is measured already.
    wanted: dict[str, str] = {}
    for task in arguments.tasks:
        for key in (NOISE, *departures(task)):
            if key not in entries:
                wanted.setdefault(key, task)
    bases = {}
    for task in dict.fromkeys(wanted.values()):
        runs = sorted(arguments.runs.glob(f"{task}-default-n*-seed0/evaluation.json"))
        if not runs:
            sys.exit(f"error: --runs: expected a finished run of {task} in {arguments.runs}.")
        bases[task] = runs[0].parent
    for key, task in wanted.items():
        found = measure(task, key, bases[task], arguments.out / f"{task}-{key}")
        entries[key] = {"task": task, **found, "origin": origin_text(describe_origin(seed=0))}
        write(entries)
        print(f"{key}={found['value']}: {entries[key]['effect']}", flush=True)
    write(entries)


if __name__ == "__main__":
    main()
