"""How well hybrid and data-driven models predict, fitted to the same real transitions.

    python benchmarks/paper/model_error.py --tasks pendulum acrobot --seed 0

Collects as the default preset does, fits both models alike, and measures the distance after 20
steps on episodes that neither saw: random actions from the task's coverage box and its resets, by
evaluation seeds. Writes results/model_error/<task>.json for every task and a README.md beside them.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict

from measures import PREDICTION_EPISODES, PREDICTION_STEPS, PUBLISHED_SAMPLES, prediction_errors
from phihp_torchrl import HybridDynamics, get_task, load_config
from phihp_torchrl.dynamics import DynamicsLoss, PhysicsPrior, fit, split
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import ModelConfig, ModelTrainer, make_dynamics, read_run_config
from phihp_torchrl.worlds import SimulatedWorld

RESULTS = Path("results/model_error")


def model_config(task: str, *changes: str) -> ModelConfig:
    """The default preset's phase 1, but for changes as on the command line."""
    return read_run_config(load_config(task, overrides=changes)).section("model")


def compare(name: str, seed: int) -> dict[str, object]:
    """Collect once, fit both models to it."""
    task, config = get_task(name), model_config(name)
    world = SimulatedWorld(task)
    torch.manual_seed(seed)
    trainer = ModelTrainer(task, config, seed=seed, world=world)
    while not trainer.done:
        trainer.advance()
    constants = {}
    if isinstance(trainer.dynamics.prior, PhysicsPrior):
        guess = PhysicsPrior(task.system)
        guess.load_state_dict({"log_constants": trainer.initial["prior.log_constants"]})
        for label, values in (
            ("truth", world.truth.constants),
            ("guess", guess.constants()),
            ("identified", trainer.dynamics.prior.constants()),
        ):
            identifiable = task.system.identifiable(values)
            constants[label] = {key: float(value) for key, value in identifiable.items()}
    return {
        "task": name,
        "seed": seed,
        "real_steps": trainer.real_steps,
        "hybrid": prediction_errors(world, trainer.dynamics),
        "data_driven": prediction_errors(world, fit_data_driven(world, config, trainer.data, seed)),
        "constants": constants,
        "origin": origin_text(describe_origin(seed)),
    }


def fit_data_driven(
    world: SimulatedWorld, config: ModelConfig, data: TensorDict, seed: int
) -> HybridDynamics:
    """The same transition without prior, from the same data, by the same method."""
    torch.manual_seed(seed)
    dynamics = make_dynamics(world, replace(config, kind="data_driven"))
    train, held_out, _ = split(data)
    generator = torch.Generator().manual_seed(seed)
    fit(DynamicsLoss(dynamics), train, held_out, config.fit, generator)
    return dynamics


def write_tables() -> None:
    """The tables of all tasks compared so far."""
    results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    order = {task: i for i, task in enumerate(PUBLISHED_SAMPLES)}
    results.sort(key=lambda result: order.get(result["task"], len(order)))
    errors, constants = [], []
    origins = "; ".join(f"{r['task']}, {r.get('origin', 'not recorded')}" for r in results)
    for result in results:
        for where in ("reset", "coverage"):
            parts = [
                f"{result[kind][f'{where}_{statistic}']:.2g}"
                for kind in ("hybrid", "data_driven")
                for statistic in ("mean", "median")
            ]
            errors.append([result["task"], where, str(result["real_steps"]), *parts])
        for key, truth in result["constants"].get("truth", {}).items():
            guess, found = (result["constants"][label][key] for label in ("guess", "identified"))
            off = f"{100 * (found / truth - 1):+.1f} %"
            row = [result["task"], key, f"{truth:.4g}", f"{guess:.4g}", f"{found:.4g}", off]
            constants.append(row)
    error_header = ["task", "episodes from", "real samples", "hybrid, mean", "median"]
    error_header += ["data-driven, mean", "median"]
    constants_header = ["task", "constant", "truth", "first guess", "identified", "off by"]
    text = (
        "# Held-out prediction\n\n"
        "Made by `python benchmarks/paper/model_error.py`: distance between true and predicted "
        f"state after {PREDICTION_STEPS} steps, over {PREDICTION_EPISODES} episodes from "
        "evaluation seeds.\n\n"
        f"{markdown_table(error_header, errors)}\n"
        "# Identified constants\n\n"
        "Each constant's first guess is 30 % off; the combinations that the motion determines:\n\n"
        f"{markdown_table(constants_header, constants)}\n"
        f"Made at: {origins}.\n"
    )
    (RESULTS / "README.md").write_text(text)


def main() -> None:
    """Compare on every task asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(PUBLISHED_SAMPLES))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name in arguments.tasks:
        result = compare(name, arguments.seed)
        (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=2) + "\n")
        write_tables()
        print(f"{name}: hybrid {result['hybrid']}, data-driven {result['data_driven']}", flush=True)


if __name__ == "__main__":
    main()
