"""Plans by the cross-entropy method for a :class:`points.Point`, and what they scored."""

from __future__ import annotations

import torch
from points import ZEROS, point_problem

from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.planners import CEMConfig, candidates, cem_plan, score_sequences

VARIANTS = [
    {},
    {"num_policy_candidates": 10},
    {"num_policy_candidates": 10, "num_kept_elites": 3, "select": "best"},
    {"num_policy_candidates": 40, "optim_steps": 1, "policy_noise": 0.2, "min_std": 0.1},
    {"num_policy_candidates": 1, "compare_with_actor": False, "num_kept_elites": 6},
]


def settings(**kwargs):
    """Small, and without an actor's candidates unless a test asks for them."""
    sizes = {"planning_horizon": 4, "optim_steps": 3, "num_candidates": 40, "top_k": 6}
    policy = {"num_policy_candidates": 0, "policy_noise": 0.05, "policy_noise_clip": 0.3}
    return CEMConfig(**{**sizes, **policy, **kwargs})


def draw(settings, batch=(), seed=0, action_dim=2):
    generator = torch.Generator().manual_seed(seed)
    shape = settings.noise_shape(batch, action_dim)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def flat_value(observation, action):
    return -observation.square().sum(-1) - action.square().sum(-1)


def spy_on_scores(monkeypatch):
    """A list that fills with the (actions, scores) of each scoring."""
    seen = []

    def spy(*args, **kwargs):
        scores, actions = score_sequences(*args, **kwargs)
        seen.append((actions, scores))
        return scores, actions

    monkeypatch.setattr(candidates, "score_sequences", spy)
    return seen


@torch.no_grad()
def compiled_and_eager():
    """The actions of a small plan, of compiled code and of eager."""
    chosen = settings(planning_horizon=1, optim_steps=1, num_candidates=4, top_k=2)
    problem, noise = point_problem(), draw(chosen)

    def plan(observation):
        return cem_plan(observation, noise, problem=problem, settings=chosen).actions

    return [function(ZEROS).tolist() for function in (compile_graph(plan), plan)]
