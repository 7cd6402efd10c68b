"""How small networks can be, and of which kind: imagined return over CPU time.

    python benchmarks/paper/networks.py --tasks cartpole-swingup --variants default 2x128 --seeds 20
    python benchmarks/paper/networks.py --only-write       # the tables of what there is

Trains actor and critics in the fitted models of the agents in results/agents, by the task's default
settings but for those of the variant, and takes note of the imagined return over the seconds of CPU
spent. No real step is taken and no real episode played: networks are chosen in imagination alone.
Writes results/networks/{task}-{variant}-seed{seed}.json after every evaluation, and README.md.

What stands between two layers is no setting of the package, whose networks have ReLU. A variant
that has something else replaces it in this process alone, where TD3 learns.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn import functional as F

from phihp_torchrl import load_agent, load_config
from phihp_torchrl.agents import Layers, equations, networks
from phihp_torchrl.evaluation import TARGETS, markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import PolicyTrainer, planned_acts, read_run_config

AGENTS, RESULTS = Path("results/agents"), Path("results/networks")


def widths(actor: list[int], critic: list[int], *rates: float) -> list[str]:
    """Settings of networks of these widths, with learning rates of the actor and of the critics."""
    names = ("actor_learning_rate", "critic_learning_rate")
    return [
        f"policy.td3.actor_hidden_sizes={actor}",
        f"policy.td3.critic_hidden_sizes={critic}",
        *(f"policy.td3.{name}={rate}" for name, rate in zip(names, rates, strict=False)),
    ]


class Variant(NamedTuple):
    """Settings that differ, and what stands between two layers."""

    settings: list[str] = []
    between: str = "relu"


def _norm(values: Tensor) -> Tensor:
    """Layer normalisation without weights of its own, then ReLU."""
    return F.layer_norm(values, values.shape[-1:]).relu()


BETWEEN = {"relu": torch.relu, "silu": F.silu, "tanh": torch.tanh, "norm": _norm}

THREE_128 = widths([128, 128], [128, 128, 128], 1e-3, 2e-3)

VARIANTS: dict[str, Variant] = {
    "default": Variant(),
    "wide": Variant(widths([300, 300], [200, 200, 200], 3e-4, 1e-3)),
    "2x64": Variant(widths([64, 64], [64, 64], 1e-3, 2e-3)),
    "3x64": Variant(widths([64, 64], [64, 64, 64], 1e-3, 2e-3)),
    "2x96": Variant(widths([96, 96], [96, 96], 1e-3, 2e-3)),
    "2x128": Variant(widths([128, 128], [128, 128], 1e-3, 2e-3)),
    "2x128-slow": Variant(widths([128, 128], [128, 128])),
    "3x128": Variant(THREE_128),
    "3x128-slow": Variant(widths([128, 128], [128, 128, 128], 5e-4, 1e-3)),
    "2x64-128": Variant(widths([64, 64], [128, 128], 1e-3, 2e-3)),
    "norm": Variant(between="norm"),
    "3x128-norm": Variant(THREE_128, between="norm"),
    "silu": Variant(between="silu"),
    "tanh": Variant(between="tanh"),
    "batch-128": Variant(["policy.batch_size=128"]),
}


@contextmanager
def between_layers(name: str) -> Iterator[None]:
    """Put this between the layers of TD3's actors and critics, in the place of ReLU."""
    if name == "relu":
        yield
        return
    apply = BETWEEN[name]

    def mlp(layers: Layers, inputs: Tensor) -> Tensor:
        for weight, bias in zip(layers[:-2:2], layers[1:-2:2], strict=True):
            inputs = apply(F.linear(inputs, weight, bias))
        return F.linear(inputs, layers[-2], layers[-1])

    def prepare(layers: Layers) -> Callable[[Tensor], Tensor]:
        return partial(mlp, layers)

    with ExitStack() as stack:
        stack.enter_context(patch.object(equations, "mlp", mlp))
        for module in (equations, networks, planned_acts):
            stack.enter_context(patch.object(module, "prepare", prepare))
        yield


def train(
    task: str, variant: str, seed: int, path: Path, compile: bool, commit: str | None
) -> None:
    """One policy phase in the model of the task's agent."""
    agent = load_agent(AGENTS / task)
    settings = VARIANTS[variant].settings
    config = read_run_config(load_config(task, overrides=settings)).section("policy")
    torch.manual_seed(seed)
    assert agent.dynamics is not None  # of an agent that was trained in it
    trainer = PolicyTrainer(agent.task, agent.dynamics, config, seed=seed, compile=compile)
    origin = describe_origin(seed)
    if commit:
        origin |= {"commit": commit, "dirty": False}
    curve: list[dict[str, float]] = []
    begun = time.process_time()
    while not trainer.done:
        metrics = trainer.advance()
        curve.append(
            {
                "updates": metrics["policy/updates"],
                "cpu_seconds": round(time.process_time() - begun, 2),
                "return": metrics["policy/imagined_return"],
                "best": metrics["policy/best_imagined_return"],
                **({"lag": metrics[k]} if (k := "policy/critic_lag") in metrics else {}),
            }
        )
        record = {
            "task": task,
            "variant": variant,
            "settings": settings,
            "between": VARIANTS[variant].between,
            "compiled": compile,
            "seed": seed,
            "done": trainer.done,
            "curve": curve,
            "origin": origin,
        }
        partial = path.with_suffix(".part")
        partial.write_text(json.dumps(record) + "\n")
        os.replace(partial, path)
    print(f"{path.stem}: {curve[-1]}", flush=True)


def write_tables(results: Path) -> None:
    """A table for each task: what variants reach, and when."""
    runs = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    text = (
        "# Networks\n\nMade by `python benchmarks/paper/networks.py`. Do not edit. Returns are "
        "imagined, of the best actor. Seconds are of CPU time, one thread, from the first "
        "evaluation on. Runs by default compile nothing; rows that did say so. *Default* is what "
        "the settings of its commit said, not those of today.\n"
    )
    for task in TARGETS:
        mine = [run for run in runs if run["task"] == task and run["done"]]
        cut = sorted({r["variant"] for r in runs if r["task"] == task and not r["done"]})
        if not mine:
            continue
        floor = min(run["curve"][0]["best"] for run in mine)
        top = max(run["curve"][-1]["best"] for run in mine)
        table = []
        for variant in sorted({_row(run) for run in mine}):
            here = [run for run in mine if _row(run) == variant]
            level = floor + 0.98 * (top - floor)
            reached = [
                next(
                    (
                        p["cpu_seconds"] - run["curve"][0]["cpu_seconds"]
                        for p in run["curve"]
                        if p["best"] >= level
                    ),
                    None,
                )
                for run in here
            ]
            per_thousand = [
                1e3
                * (run["curve"][-1]["cpu_seconds"] - run["curve"][0]["cpu_seconds"])
                / (run["curve"][-1]["updates"] - run["curve"][0]["updates"])
                for run in here
            ]
            table.append(
                [
                    variant,
                    ", ".join(str(run["seed"]) for run in here),
                    ", ".join(f"{run['curve'][-1]['best']:.1f}" for run in here),
                    f"{mean(run['curve'][-1]['best'] for run in here):.1f}",
                    ", ".join("–" if s is None else f"{s:.0f}" for s in reached),
                    f"{mean(per_thousand):.1f}",
                ]
            )
        header = ["networks", "seeds", "best imagined return", "mean"]
        header += ["seconds to 98 % of the way", "seconds per 1,000 updates"]
        text += f"\n## {task}\n\n{markdown_table(header, table)}\n"
        text += f"\nNot finished, and left out: {', '.join(cut)}.\n" if cut else ""
    used = {run["variant"] for run in runs}
    origins = sorted({origin_text(run["origin"]) for run in runs})
    text += "\n" + "; ".join(origins) + ".\n\nVariants: "
    text += "; ".join(f"{name}: {_words(v)}" for name, v in VARIANTS.items() if name in used)
    text += ".\n"
    (results / "README.md").write_text(text)


def _row(run: dict[str, Any]) -> str:
    """The row of a run in its task's table."""
    return f"{run['variant']}, compiled" if run.get("compiled") else run["variant"]


def _words(variant: Variant) -> str:
    """What differs from the default, in words."""
    words = [f"`{' '.join(variant.settings)}`"] if variant.settings else []
    if variant.between != "relu":
        kind = "layer norm and ReLU" if variant.between == "norm" else variant.between
        words.append(f"{kind} between layers")
    return ", ".join(words) or "as set"


def main() -> None:
    """Train what is missing, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[20])
    parser.add_argument("--compile", action="store_true", help="as no default run does")
    parser.add_argument("--commit", help="of the code, where it is run outside its repository")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--only-write", action="store_true")
    options = parser.parse_args()
    options.results.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    if not options.only_write:
        for seed in options.seeds:
            for task in options.tasks:
                for variant in options.variants:
                    path = options.results / f"{task}-{variant}-seed{seed}.json"
                    if not (path.is_file() and json.loads(path.read_text())["done"]):
                        with between_layers(VARIANTS[variant].between):
                            train(task, variant, seed, path, options.compile, options.commit)
    write_tables(options.results)


if __name__ == "__main__":
    main()
