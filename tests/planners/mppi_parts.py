"""Plans by path integral control for a :class:`points.Point`."""

from __future__ import annotations

import torch
from points import point_problem

from phihp_torchrl.planners import MPPIConfig, MPPINoise, mppi_plan


def settings(**kwargs):
    defaults = {
        "planning_horizon": 4,
        "optim_steps": 4,
        "num_candidates": 60,
        "top_k": 8,
        "num_policy_candidates": 0,
        "init_std": 1.0,
        "select": "mean",
    }
    return MPPIConfig(**{**defaults, **kwargs})


def draw(s, batch=(), seed=0, action_dim=2):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    guided = s.num_policy_candidates
    return MPPINoise(
        normal(s.optim_steps, s.planning_horizon, s.num_candidates - guided, *batch, action_dim),
        normal(s.planning_horizon, guided, *batch, action_dim),
        torch.rand(s.top_k, *batch, generator=generator, dtype=torch.float64),
    )


def plan(state, noise, s, mean=None, **kwargs):
    min_std = torch.tensor(s.min_std, dtype=torch.float64)
    return mppi_plan(state, noise, mean, min_std, problem=point_problem(**kwargs), settings=s)
