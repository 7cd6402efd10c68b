"""The number among the metrics of a run that matters most, in words."""

from __future__ import annotations

from collections.abc import Mapping

_WORDS = {
    "evaluate/planner/return_mean": "return of the planner",
    "evaluate/actor/return_mean": "return of the actor alone",
    "return_mean": "return",
    "policy/best_imagined_return": "best imagined return",
    "calibrate/gain": "gain over the actor",
    "tdmpc/episode_return": "return",
    "model/rollout_error_20": "error 20 steps ahead",
    "model/held_out_error": "held-out error",
}
"""Metrics by how much they matter, with their words."""


def headline(metrics: Mapping[str, float]) -> str:
    """The number that matters, in words; empty if there is none.

    Args:
        metrics: the last value of each metric of a run.

    Examples:
        >>> headline({"policy/loss_actor": 3.0, "policy/best_imagined_return": -341.23})
        'best imagined return -341.2'
        >>> headline({"nap/deepest_error": 0.12345}), headline({"nap/count": 3.0})
        ('nap/deepest_error 0.1235', '')
    """
    for name, words in _WORDS.items():
        if name in metrics:
            return f"{words} {metrics[name]:.4g}"
    for part in ("return", "error", "loss"):
        for name, value in metrics.items():
            if part in name and not name.startswith("evaluate/"):  # such as that of a baseline
                return f"{name} {value:.4g}"
    return ""
