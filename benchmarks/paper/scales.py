"""Whether phase 2 learns alike in any units of states and rewards.

    python benchmarks/paper/scales.py

Trains actor and critics in the true model of one oscillator, whose states and rewards are expressed
in units a thousand times larger or smaller, with ``policy.scales`` auto and none, and writes
results/scales/scales.json and README.md. The returns are in the units of factor 1, so that all of
them would be equal if units did not matter.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl import Box, HybridDynamics, System, Task
from phihp_torchrl.agents import RefitConfig, TD3Config
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.trainers import PolicyConfig, PolicyTrainer


class Wells(System):
    """x'' = x - x³ + a, with states in units of 1 / ``unit``: wells at ±1, a hill at 0."""

    state_names, action_names = ("x", "x_dot"), ("force",)
    velocity_of = {"x": "x_dot"}
    default_constants = {"stiffness": 1.0}

    def __init__(self, unit: float) -> None:
        super().__init__()
        self.unit = unit

    def prior(self, state: Tensor, action: Tensor, constants: Mapping[str, Any]) -> Tensor:
        """The equation of motion, which is all of the truth."""
        x, x_dot = (state / self.unit).unbind(-1)
        force = constants["stiffness"] * x - x**3 + action[..., 0]
        return self.unit * torch.stack([x_dot, force], -1)


def make_task(state_unit: float, reward_unit: float) -> Task:
    """Leave the left well and come to rest in the right one."""

    def reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        x, x_dot = (next_state / state_unit).unbind(-1)
        cost = (x - 1.0).square() + 0.1 * x_dot.square() + 0.1 * action[..., 0].square()
        return -reward_unit * cost

    def box(center: tuple[float, ...], radius: tuple[float, ...]) -> Box:
        return Box.around(
            tuple(state_unit * c for c in center), tuple(state_unit * r for r in radius)
        )

    return Task(
        name=f"wells-{state_unit:g}-{reward_unit:g}",
        system=Wells(state_unit),
        action_high=(0.5,),
        time_step=0.1,
        max_steps=200,
        reset=box((-1.0, 0.0), (0.05, 0.05)),
        reward=reward,
        coverage=box((0.0, 0.0), (1.8, 1.5)),
        goal=box((1.0, 0.0), (0.3, 0.3)),
    )


class Trial(NamedTuple):
    """One run of phase 2."""

    state_unit: float
    reward_unit: float
    scales: str
    seed: int
    imagined_return: float
    """Best return in the model, in the units of factor 1."""
    seconds: float


def learn(
    state_unit: float, reward_unit: float, scales: str, seed: int, updates: int = 3000
) -> Trial:
    """Run phase 2 in the true model."""
    torch.manual_seed(seed)
    task = make_task(state_unit, reward_unit)
    config = PolicyConfig(
        updates=updates,
        real_evaluation_episodes=0,
        scales=scales,
        td3=TD3Config(actor_hidden_sizes=(64, 64), critic_hidden_sizes=(64, 64)),
        refit=RefitConfig(interval=0),
    )
    start = time.perf_counter()
    trainer = PolicyTrainer(task, HybridDynamics.pure_prior(task), config, seed=seed)
    while not trainer.done:
        trainer.advance()
    seconds = time.perf_counter() - start
    return Trial(state_unit, reward_unit, scales, seed, trainer.best_return / reward_unit, seconds)


UNITS = ((1.0, 1.0), (1000.0, 1.0), (0.001, 1.0), (1.0, 1000.0), (1.0, 0.001))
"""Units of states and of rewards."""
SCALES = ("auto", "none")


def table(trials: list[Trial]) -> str:
    """Mean returns over seeds, a row for each pair of units."""
    rows = []
    for units in UNITS:
        row = [f"{unit:g}" for unit in units]
        for scales in SCALES:
            found = [t.imagined_return for t in trials if t[:3] == (*units, scales)]
            row.append(f"{mean(found):.1f} ({min(found):.1f} to {max(found):.1f})")
        rows.append(row)
    headers = ["states are multiplied by", "rewards by", *(f"scales={s}" for s in SCALES)]
    return markdown_table(headers, rows)


def main() -> None:
    """Learn in each of the units, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("results/scales"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    trials = [
        learn(*units, scales, seed)
        for units in UNITS
        for scales in SCALES
        for seed in range(arguments.seeds)
    ]
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = [trial._asdict() for trial in trials]
    Path(arguments.out, "scales.json").write_text(json.dumps(rows, indent=2) + "\n")
    text = (
        "# Learning in other units\n\n"
        "Written by `python benchmarks/paper/scales.py`, which says what is learned. Best imagined "
        f"return, mean and range over {arguments.seeds} seeds, in the units of the first row.\n\n"
        f"{table(trials)}\nMade at: {origin_text(describe_origin(0))}.\n"
    )
    Path(arguments.out, "README.md").write_text(text)


if __name__ == "__main__":
    main()
