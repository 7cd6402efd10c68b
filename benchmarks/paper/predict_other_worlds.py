"""How well models of worlds that others made predict, from at most 4,000 of their steps.

    python benchmarks/paper/predict_other_worlds.py --seeds 100 101 102

Needs the extra ``dmcontrol``. Phase 1 collects 2,000 transitions, at random and by planning, and
fits the model as told; other fits get the same data. Errors are measured on 1,000 transitions of
other episodes, half of them random and half planned. Writes one JSON file for each world and seed
to results/other_worlds, and a README.md beside them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from other_worlds import STEPS, WORLDS, Fit, OtherWorld, shares
from phihp_torchrl.dynamics import DynamicsLoss, FitConfig, PhysicsPrior, fit, split
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import (
    ModelConfig,
    ModelTrainer,
    make_dynamics,
    planning_policy,
    random_policy,
)
from phihp_torchrl.worlds import make_world

RESULTS = Path("results/other_worlds")
TRANSITIONS, TESTED, PERIOD = 2000, 500, 400
AS_TOLD = "as told"


def measure(name: str, seed: int) -> dict[str, Any]:
    """Collect and fit as told, and fit the same data in other ways."""
    world = WORLDS[name]
    torch.manual_seed(seed)
    config = ModelConfig(real_steps=TRANSITIONS, steps_per_iteration=PERIOD, **world.model)
    trainer = ModelTrainer(world.task, config, seed=seed, world=world.make_env)
    start = time.perf_counter()
    while not trainer.done:
        trainer.advance()
    seconds = time.perf_counter() - start
    tested = unseen(trainer, seed)
    fits = {AS_TOLD: result(trainer.loss, tested, world) | {"seconds": seconds}}
    for label, way in world.others.items():
        fits[label] = fit_otherwise(trainer, way, seed, tested, world)
    return {
        "world": name,
        "seed": seed,
        "transitions": trainer.real_steps,
        "environment_steps": trainer.real_steps * world.repeat,
        "tested": len(tested),
        "fits": fits,
        "origin": origin_text(describe_origin(seed)),
    }


def unseen(trainer: ModelTrainer, seed: int) -> TensorDict:
    """Transitions that no fit sees, from random and from planned actions."""
    generator = torch.Generator().manual_seed(seed + 1000)
    task, config, env = trainer.task, trainer.config.collect, trainer.env
    assert env is not None
    parts: list[TensorDict] = []
    for policy in (
        random_policy(task, config, generator),
        planning_policy(task, trainer.dynamics, config, generator, config.noise),
    ):
        env.set_seed(seed + 1000 + len(parts))
        with torch.no_grad():
            rollout = env.rollout(TESTED, policy, break_when_any_done=False)
        keys: tuple[Any, ...] = ("observation", "action", ("next", "observation"), ("next", "done"))
        part = rollout.select(*keys).clone()
        part["next", "done"][-1] = True
        parts.append(part)
    return torch.cat(parts)


def fit_otherwise(
    trainer: ModelTrainer, way: Fit, seed: int, tested: TensorDict, world: OtherWorld
) -> dict[str, Any]:
    """Fit the same data in another way, from the same kind of first guess."""
    torch.manual_seed(seed)
    dynamics = make_dynamics(make_world(way.task, world.make_env), ModelConfig(**way.model))
    loss = DynamicsLoss(dynamics)
    train, held_out, _ = split(trainer.data)
    start = time.perf_counter()
    config = replace(FitConfig(), robust=way.robust)
    fit(loss, train, held_out, config, torch.Generator().manual_seed(seed))
    return result(loss, tested, world) | {"seconds": time.perf_counter() - start}


def result(loss: DynamicsLoss, tested: TensorDict, world: OtherWorld) -> dict[str, Any]:
    """Errors and constants of a fitted model."""
    prior = loss.dynamics.prior
    assert isinstance(prior, PhysicsPrior)
    found = {key: float(value) for key, value in prior.constants().items()}
    return {"errors": shares(loss, tested, world.stops), "constants": found}


def table(results: list[dict[str, Any]]) -> str:
    """One row for each world and fit, the worst of the seeds."""
    rows = []
    for name in WORLDS:
        runs = [r for r in results if r["world"] == name]
        for label in runs[0]["fits"] if runs else ():
            fits = [run["fits"][label] for run in runs]
            cells = [worst(fits, steps, place) for place in ("away", "overall") for steps in STEPS]
            rows.append([name, label, str(len(runs)), *cells])
    header = ["world", "fit", "seeds"]
    header += [f"{place}, {n} step{'s' * (n > 1)}" for place in ("away", "overall") for n in STEPS]
    return markdown_table(header, rows)


def worst(fits: list[Mapping[str, Any]], steps: int, place: str) -> str:
    """The largest error of a state in any of the fits."""
    sizes = [
        share
        for fitted in fits
        for state, share in fitted["errors"][str(steps)].get(place, {}).items()
        if state != "windows"
    ]
    return f"{max(sizes):.2g}" if sizes else "none"


def write_readme() -> None:
    """The table of all runs so far."""
    results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    origins = "; ".join(sorted({r["origin"] for r in results}))
    seeds = sorted({r["seed"] for r in results})
    steps = max(r["environment_steps"] for r in results)
    text = (
        "# Prediction in worlds that others made\n\n"
        "Written by `python benchmarks/paper/predict_other_worlds.py --seeds "
        f"{' '.join(map(str, seeds))}`, which says what is fitted and measured. Errors are root "
        "mean squares as a share of the change in as many steps, so that 1 is as bad as to predict "
        "that nothing changes; the worst state of the worst seed. *Away* are windows that meet no "
        "stop.\n\n"
        f"At most {steps} steps of an environment are fitted. *As told* knows the textbook's "
        "equations with guesses 30 % off, that there are stops and of which kind, and the "
        "integrator of the simulator; friction is left to the residual. *Default settings* have "
        "semi-implicit Euler without substeps. All fits of a world have the same data.\n\n"
        f"{table(results)}\nMade at: {origins}.\n"
    )
    (RESULTS / "README.md").write_text(text)


def main() -> None:
    """Measure in every world asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--seeds", nargs="*", type=int, default=[100], help="none: table alone")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:
        for name in arguments.worlds:
            found = measure(name, seed)
            path = RESULTS / f"{name.lower().replace(' ', '-')}-{seed}.json"
            path.write_text(json.dumps(found, indent=2) + "\n")
            print(name, seed, table([found]), flush=True)
    write_readme()


if __name__ == "__main__":
    main()
