"""Plans by the cross-entropy method for a :class:`points.Point`, and what they scored."""

from __future__ import annotations

import torch

from phihp_torchrl.planners import CEMConfig, candidates, score_sequences

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
