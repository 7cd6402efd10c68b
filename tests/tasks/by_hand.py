"""Rewards and ends of nested lists, in float64."""

from __future__ import annotations

import torch

from phihp_torchrl import get_task


def rewards(name, states, actions, next_states):
    """Rewards as floats."""
    tensors = (torch.tensor(x, dtype=torch.float64) for x in (states, actions, next_states))
    return get_task(name).reward(*tensors).tolist()


def ends(name, *next_states):
    """Whether each next state ends an episode."""
    return get_task(name).is_terminated(torch.tensor(next_states, dtype=torch.float64)).tolist()
