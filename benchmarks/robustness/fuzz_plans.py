"""A million plans of random planners, models, actors and critics, from observations of any size.

    python benchmarks/robustness/fuzz_plans.py                    # 10^6 plans
    python benchmarks/robustness/fuzz_plans.py --plans 20000

Every plan must be finite and within the bounds of the action, whatever the model answers: weights
are drawn large enough for states to overflow. Writes results/robustness/fuzz_plans.json.
"""

from __future__ import annotations

import argparse
import random
from collections import Counter
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from found import write_part
from phihp_torchrl import Agent, ConfigError, HybridDynamics, get_task
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.planners import CEMConfig, MPPIConfig, SearchConfig
from phihp_torchrl.tasks import list_tasks

ROWS = 5_000
"""Plans in a call."""
SCALES = (0.0, 1.0, 1.0, 1e2, 1e4)
"""Factors on the weights."""
SIZES = (1e-30, 1.0, 1.0, 1e2, 1e6, 1e18, 1e37)
"""Sizes of observations."""


def main() -> None:
    """Plan and check until there are enough plans."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plans", type=int, default=1_000_000)
    wanted = parser.parse_args().plans
    torch.set_num_threads(1)
    torch.manual_seed(0)
    draw, found = random.Random(0), Counter[str]()
    while found["plans"] < wanted:
        try:
            agent = make_agent(draw)
        except ConfigError:
            found["refused"] += 1
            continue
        found["planners"] += 1
        check(agent, draw, found)
    counted = {name: found[name] for name in
               ("plans", "planners", "refused", "not_finite", "out_of_bounds")}  # fmt: skip
    record = {**counted, "largest_scale": max(SCALES), "largest_observation": max(SIZES)}
    write_part("fuzz_plans", record)
    print(record)


def make_agent(draw: random.Random) -> Agent:
    """An agent of random settings and weights, for a random task."""
    task = get_task(draw.choice(sorted(list_tasks())))
    dynamics = HybridDynamics.hybrid(task, hidden_sizes=(8,))
    actor = Actor(task, (8,)) if draw.random() < 0.7 else None
    qvalue = TwinQ(task, (8,)) if actor is not None and draw.random() < 0.7 else None
    for module in (dynamics, actor, qvalue):
        if module is not None:
            scale_weights(module, draw.choice(SCALES))
    return Agent(
        task,
        dynamics=dynamics,
        actor=actor,
        qvalue=qvalue,
        planner_config=make_settings(draw, has_actor=actor is not None),
    )


def scale_weights(module: nn.Module, scale: float) -> None:
    """Make the weights of the networks of a module larger; the constants of equations stay."""
    with torch.no_grad():
        for part in module.modules():
            if isinstance(part, nn.Linear):
                part.weight.mul_(scale)


def make_settings(draw: random.Random, *, has_actor: bool) -> SearchConfig:
    """Random settings of a planner, from the whole range of most."""
    candidates = draw.randint(2, 12)
    shared: dict[str, Any] = {
        "planning_horizon": draw.randint(1, 4),
        "optim_steps": draw.randint(1, 3),
        "num_candidates": candidates,
        "top_k": draw.randint(1, candidates),
        "num_policy_candidates": draw.randint(0, candidates) if has_actor else 0,
        "policy_noise": draw.choice((0.0, 0.2, 1e6)),
        "policy_noise_clip": draw.choice((0.0, 0.6, 1e6)),
        "alpha": draw.choice((0.0, 1.0, 1e6)),
        "gamma": draw.choice((0.0, 0.99, 1.0)),
        "init_std": draw.choice((1e-6, 1.0, 1e6)),
        "min_std": draw.choice((0.0, 0.05, 1.0)),
        "noise_beta": draw.choice((0.0, 1.0, 4.0)),
        "change_cost": draw.choice((0.0, 1.0, 1e6)),
    }
    if draw.random() < 0.5:
        return MPPIConfig(
            **shared,
            temperature=draw.choice((1e-6, 0.5, 1e6)),
            momentum=draw.choice((0.0, 0.1, 0.99)),
            select=draw.choice(("sample", "mean")),
        )
    warm = draw.random() < 0.5
    return CEMConfig(
        **shared,
        select=draw.choice(("mean", "best")),
        compare_with_actor=draw.random() < 0.5,
        actor_margin=draw.choice((0.0, 1.0)),
        num_kept_elites=draw.randint(0, shared["top_k"]),
        warm_start=warm,
        keep_incumbent=warm and draw.random() < 0.5,
        replan_every=draw.randint(1, shared["planning_horizon"]),
    )


def check(agent: Agent, draw: random.Random, found: Counter[str]) -> None:
    """Plan twice, at the start of an episode and after it, and count what is wrong."""
    task = agent.task
    low, high = task.bounds[:2]
    real = task.observe(task.sample_start([ROWS]))
    for starts in (True, False):
        strange = draw.choice(SIZES) * torch.randn(ROWS, task.observation_dim)
        taken = torch.rand(ROWS, 1) < 0.5
        observation = torch.where(taken, strange.clamp(-3e38, 3e38), real)
        is_init = torch.full((ROWS,), starts)
        given = TensorDict(observation=observation, is_init=is_init, batch_size=[ROWS])
        action = agent(given)["action"]
        found["plans"] += ROWS
        found["not_finite"] += int((~action.isfinite().all(-1)).sum())
        found["out_of_bounds"] += int(((action < low) | (action > high)).any(-1).sum())


if __name__ == "__main__":
    main()
