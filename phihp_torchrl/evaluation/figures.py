"""Figures of episodes."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phihp_torchrl.evaluation.episode import Episode

# Figures are made without pyplot: no window, no global state, and `savefig` draws with Agg.


def episode_figure(episode: Episode) -> Figure:
    """Plot states, actions and rewards of an episode over time; angles in [-π, π).

    Args:
        episode: the episode.

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
    task, system = episode.task, episode.task.system
    panels = len(system.state_names) + len(system.action_names) + 1
    figure = Figure(figsize=(7.0, 0.6 + 1.1 * panels), layout="constrained")
    axes = iter(figure.subplots(panels, 1, sharex=True))
    time = task.time_step * np.arange(len(episode.states))
    for i, name in enumerate(system.state_names):
        values, axis = episode.states[:, i], next(axes)
        if name in system.angles:
            values = _with_gaps((values + math.pi) % (2 * math.pi) - math.pi)
            axis.set_yticks([-math.pi, 0, math.pi], ["-π", "0", "π"])
            axis.set_ylim(-1.1 * math.pi, 1.1 * math.pi)
        _line(axis, time, values, name, "C0")
    bounds = zip(system.action_names, task.action_low or (), task.action_high, strict=True)
    for i, (name, low, high) in enumerate(bounds):
        axis = next(axes)
        axis.step(time[:-1], episode.actions[:, i], where="post", color="C1", linewidth=1)
        axis.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        _label(axis, name)
    _line(last := next(axes), time[:-1], episode.rewards, "reward", "C2")
    last.set_xlabel("time (s)")
    end = "terminated" if episode.terminated else "ran its time"
    figure.suptitle(f"{task.name}: return {episode.total_reward:.1f}, {end}")
    return figure


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
