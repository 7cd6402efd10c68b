"""What the paper's runs, and ours, may spend on a task."""

from __future__ import annotations

from types import MappingProxyType

PUBLISHED_SAMPLES = MappingProxyType(
    {
        "pendulum": 2000,
        "pendulum-swingup": 5000,
        "cartpole": 5000,
        "cartpole-swingup": 5000,
        "cartpole-swingup-published": 5000,
        "acrobot": 5000,
        "acrobot-swingup": 15000,
    }
)
"""Real samples that PhIHP may use, by task."""

DEFAULT_SAMPLES = MappingProxyType({task: n // 2 for task, n in PUBLISHED_SAMPLES.items()})
"""Real samples that PhIHP takes in the default preset, by task."""

PUBLISHED_UPDATES = MappingProxyType(
    {task: 2_000_000 if task == "acrobot-swingup" else 500_000 for task in PUBLISHED_SAMPLES}
)
"""Imagined steps of the paper, each with an update, by task."""
