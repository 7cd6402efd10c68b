"""How the cost of a plan grows, one curve a quantity."""

from __future__ import annotations

import json
from dataclasses import replace

import torch
from conftest import RESULTS
from matplotlib.figure import Figure
from race import race
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics, Task
from phihp_torchrl.agents import make_actor, make_twin_qvalue
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import CEMConfig, make_planner
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Box

# The published budget.
CONFIG = CEMConfig(
    planning_horizon=5,
    optim_steps=3,
    num_candidates=220,
    top_k=10,
    policy_noise=0.05,
    policy_noise_clip=0.3,
    compare_with_actor=False,
)
CURVES = {
    "candidates": (32, 64, 128, 256, 512, 1024),
    "horizon": (1, 2, 5, 10, 20, 40),
    "batch of plans": (1, 2, 4, 8, 16),
    "state components": (2, 4, 8, 16, 32),
    "hidden units": (50, 100, 200, 400, 800),
}


def pendulums(count):
    """A task of that many pendulums side by side, each on its own joint."""
    angles = tuple(f"theta_{i}" for i in range(count))
    velocities = tuple(f"omega_{i}" for i in range(count))

    class Pendulums(System):
        state_names = angles + velocities
        action_names = tuple(f"torque_{i}" for i in range(count))
        velocity_of = dict(zip(angles, velocities, strict=True))
        default_constants = {"gravity": 10.0}

        def prior(self, state, action, constants):
            theta, omega = state.split(count, -1)
            return torch.cat([omega, 1.5 * constants["gravity"] * theta.sin() + 3 * action], -1)

    Pendulums.angles = angles
    return Task(
        name="pendulums",
        system=Pendulums(),
        action_high=(2.0,) * count,
        time_step=0.05,
        max_steps=200,
        reset=Box.around((0.0,) * 2 * count, (1.0,) * 2 * count),
        reward=lambda state, action, next_state: -next_state.square().sum(-1),
    )


def contender(quantity, value):
    """An eager plan in which ``quantity`` is ``value`` and all else is as published."""
    hidden = value if quantity == "hidden units" else None
    task = pendulums(value // 2 if quantity == "state components" else 1)
    actor = make_actor(task, [hidden or 300] * 2)
    qvalue = make_twin_qvalue(task, [hidden or 200] * 3)
    changes = {"candidates": "num_candidates", "horizon": "planning_horizon"}
    config = replace(CONFIG, **{changes[quantity]: value}) if quantity in changes else CONFIG
    batch = [value if quantity == "batch of plans" else 1]
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    planner = make_planner(model, actor, qvalue, config)
    observation = task.observe(task.reset.sample(batch))
    data = TensorDict(observation=observation, batch_size=batch)
    return lambda: planner(data.clone())


def test_cost(benchmark):
    points = {(q, v): contender(q, v) for q, values in CURVES.items() for v in values}
    times = race(benchmark, points, rounds=7)
    middle = {point: sorted(of)[len(of) // 2] for point, of in times.items()}
    curves = {q: {str(v): middle[q, v] for v in values} for q, values in CURVES.items()}
    figure = Figure(figsize=(12, 2.8), layout="constrained")
    for axis, (quantity, curve) in zip(
        figure.subplots(1, len(CURVES), sharey=True), curves.items(), strict=True
    ):
        axis.loglog([int(v) for v in curve], list(curve.values()), marker="o")
        axis.set_xticks([int(v) for v in curve], list(curve), minor=False)
        axis.set_xticks([], minor=True)
        axis.set_xlabel(quantity)
        axis.grid(alpha=0.3)
    figure.axes[0].set_ylabel("ms for a plan, eager")
    RESULTS.mkdir(parents=True, exist_ok=True)
    figure.savefig(RESULTS / "cost.png", dpi=110)
    (RESULTS / "cost.json").write_text(json.dumps(curves, indent=2) + "\n")
