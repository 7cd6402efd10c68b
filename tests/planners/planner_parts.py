"""A task's environment with an actor and a critic of its own, and a small CEMPlanner on it."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from phihp_torchrl import CEMPlanner, HybridDynamics, TaskWorldModel, WorldModelEnv
from phihp_torchrl.tasks import find_task


def task_parts(name, seed=0):
    torch.manual_seed(seed)
    task = find_task(name)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    observation_dim, action_dim = task.observation_dim, task.action_dim
    actor = TensorDictModule(
        nn.Sequential(
            nn.Linear(observation_dim, 16),
            nn.ReLU(),
            nn.Linear(16, action_dim),
            InBounds(task.bounds),
        ),
        ["observation"],
        ["action"],
    )
    qvalue = TensorDictModule(
        Concatenate(nn.Linear(observation_dim + action_dim, 2)),
        ["observation", "action"],
        ["state_action_value"],
    )
    return task, WorldModelEnv(model), actor, qvalue


class InBounds(nn.Module):
    def __init__(self, bounds):
        super().__init__()
        self.register_buffer("center", bounds.center)
        self.register_buffer("scale", bounds.scale)

    def forward(self, x):
        return self.center + self.scale * x.tanh()


class Concatenate(nn.Module):
    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, *inputs):
        return self.network(torch.cat(inputs, -1))


def make_planner(env, actor=None, qvalue=None, **kwargs):
    sizes = {"planning_horizon": 4, "optim_steps": 2, "num_candidates": 32, "top_k": 5}
    policy = {"num_policy_candidates": 8} if actor is not None else {}
    return CEMPlanner(env, **{**sizes, **policy, **kwargs}, actor=actor, qvalue=qvalue)


def noise_for(planner, batch=(), seed=0):
    shape = planner.settings.noise_shape(tuple(batch), planner.action_spec.shape.numel())
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))
