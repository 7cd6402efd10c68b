"""Policies to judge: constant ones, one that balances, one that draws, one that plans."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from phihp_torchrl import Agent
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import find_task
from phihp_torchrl.worlds import SimulatedWorld


def constant(value=0.0, size=1):
    return TensorDictModule(
        lambda observation: torch.full_like(observation[..., :size], value),
        ["observation"],
        ["action"],
    )


def balance():
    """Keeps CartPole upright: push the cart to where the pole leans."""
    gains = torch.tensor([0.5, 1.0, 0.0, 30.0, 5.0])
    return TensorDictModule(
        lambda obs: (obs * gains).sum(-1, keepdim=True).clamp(-10, 10), ["observation"], ["action"]
    )


class Noisy(TensorDictModuleBase):
    """Draws from the global generator, and counts what it is told."""

    in_keys = ["observation"]
    out_keys = ["action"]

    def __init__(self):
        super().__init__()
        self.starts = []

    def forward(self, tensordict):
        self.starts.append(tensordict["is_init"].clone())
        return tensordict.set("action", torch.randn_like(tensordict["observation"][..., :1]))


def planner(name="pendulum", **options):
    task = find_task(name)
    config = CEMConfig(
        planning_horizon=3, optim_steps=2, num_candidates=8, top_k=2, num_policy_candidates=2
    )
    return Agent(
        task,
        dynamics=SimulatedWorld(task).oracle(),
        actor=Actor(task, (8,)),
        qvalue=TwinQ(task, (8,)),
        planner_config=replace(config, **options),
    )
