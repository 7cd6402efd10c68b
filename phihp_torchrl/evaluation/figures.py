"""Figures of episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from phihp_torchrl.evaluation.episode import Episode
from phihp_torchrl.evaluation.predicted import Predictions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Curve = Mapping[str, Sequence[tuple[int, float]]]
"""Returns over real steps: points by what earned them."""

# Figures are made without pyplot: no window, no global state, and `savefig` draws with Agg.


def episode_figure(
    episode: Episode, predicted: Predictions | None = None, curve: Curve | None = None
) -> Figure:
    """Plot states, actions and rewards of an episode over time; angles in [-π, π).

    Args:
        episode: the episode.
        predicted: what a model predicts of its states, drawn beside them.
        curve: returns over real steps, in a panel below: points by what earned them.

    Returns:
        A figure with a panel for each state, each action and the reward.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> steps = np.zeros((3, 2)), np.zeros((2, 1)), np.array([-1.0, -2.0])
        >>> no_frames = np.zeros((0, 0, 0, 3), dtype=np.uint8)
        >>> figure = episode_figure(Episode(get_task("pendulum"), *steps, False, no_frames, 1))
        >>> [panel.get_ylabel() for panel in figure.axes]
        ['theta', 'theta_dot', 'torque', 'reward']
    """
    from matplotlib.figure import Figure  # here, for most processes draw nothing

    task, system = episode.task, episode.task.system
    panels = len(system.state_names) + len(system.action_names) + 1
    figure = Figure(figsize=(7.0, 0.6 + 1.1 * panels + 1.6 * bool(curve)), layout="constrained")
    rows = [1.0] * panels + [1.5] * bool(curve)
    all_axes = list(figure.subplots(len(rows), 1, height_ratios=rows))
    for axis in all_axes[: panels - 1]:
        axis.sharex(all_axes[panels - 1])
        axis.tick_params(labelbottom=False)
    axes = iter(all_axes)
    time = task.time_step * np.arange(len(episode.states))
    for i, name in enumerate(system.state_names):
        values, axis = episode.states[:, i], next(axes)
        drawn = [] if predicted is None else list(predicted.pieces(episode, i))
        if name in system.angles:
            values = _with_gaps((values + math.pi) % (2 * math.pi) - math.pi)
            drawn = [(at, _with_gaps((v + math.pi) % (2 * math.pi) - math.pi)) for at, v in drawn]
            axis.set_yticks([-math.pi, 0, math.pi], ["-π", "0", "π"])
            axis.set_ylim(-1.1 * math.pi, 1.1 * math.pi)
        _line(axis, time, values, name, "C0")
        for k, (at, piece) in enumerate(drawn):
            label = "model" if k == 0 else None
            axis.plot(time[at], piece, "k--", linewidth=0.9, label=label)
        if drawn and i == 0:
            axis.lines[0].set_label("episode")
            axis.legend(fontsize="x-small", ncols=2, loc="lower right")
    bounds = zip(system.action_names, task.action_low or (), task.action_high, strict=True)
    for i, (name, low, high) in enumerate(bounds):
        axis = next(axes)
        axis.step(time[:-1], episode.actions[:, i], where="post", color="C1", linewidth=1)
        axis.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        _label(axis, name)
    _line(last := next(axes), time[:-1], episode.rewards, "reward", "C2")
    last.set_xlabel("time (s)")
    if curve:
        _curve(next(axes), curve)
    end = "terminated" if episode.terminated else "ran its time"
    figure.suptitle(f"{task.name}: return {episode.total_reward:.1f}, {end}")
    if predicted is not None:
        words = (
            f"Dashed: the model, begun anew at the episode's state every {predicted.every} steps"
        )
        figure.supxlabel(words, fontsize="small")
    return figure


def _curve(axis: Axes, curve: Curve) -> None:
    for label, points in curve.items():
        alone = len(points) == 1
        steps, values = zip(*points, strict=True)
        axis.plot(steps, values, "o" if alone else ".-", markersize=5, linewidth=1, label=label)
    axis.set_xlim(left=0)
    axis.set_xlabel("real steps", fontsize="small")
    axis.legend(fontsize="x-small")
    _label(axis, "return")


def _with_gaps(angle: np.ndarray) -> np.ndarray:
    """Insert NaN where an angle passes π, so that no line is drawn there."""
    jumps = np.abs(np.diff(angle, prepend=angle[:1])) > math.pi
    return np.where(jumps, np.nan, angle)


def _line(axis: Axes, x: np.ndarray, y: np.ndarray, name: str, color: str) -> None:
    axis.plot(x, y, color=color, linewidth=1)
    _label(axis, name)


def _label(axis: Axes, name: str) -> None:
    axis.set_ylabel(name, fontsize="small")
    axis.tick_params(labelsize="small")
    axis.grid(alpha=0.3)
