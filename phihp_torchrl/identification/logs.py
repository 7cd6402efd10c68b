"""What is odd about recordings, before any fit: clock, gaps, commands and velocities."""

from __future__ import annotations

import torch

from phihp_torchrl.identification.parts import Finding
from phihp_torchrl.identification.windows import Samples
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task

_JITTER = 0.02
"""Spread of the intervals, as a share of their mean, from which on a clock is irregular."""
_BEYOND = 0.01
"""Share of the commands beyond the bounds from which on they are named. Fewer may be glitches of a
log; a wrong unit takes nearly all, or, where a drive mostly rests, those that move it."""
_SLACK = 0.05
"""By how much of the range a command may be beyond a bound, as the noise of a measured one is."""


def of_recordings(task: Task, samples: Samples) -> list[Finding]:
    """Clock, missing samples, commands beyond their bounds or still, velocities that are none."""
    system, found = task.system, _beyond(task, samples)
    inside = samples.stretch[1:] == samples.stretch[:-1]
    intervals = samples.interval[:-1][inside]
    spread = float(intervals.std() / intervals.mean()) if len(intervals) > 1 else 0.0
    if spread > _JITTER:
        found.append(
            Finding(
                "clock",
                f"The clock is irregular: intervals of {float(intervals.min()):.3g} to "
                f"{float(intervals.max()):.3g} s, {100 * spread:.0f} % of the mean apart.",
                "Each interval was integrated as it is; keep the stamps, and do not resample.",
            )
        )
    same_episode = samples.first[1:] == samples.first[:-1]
    gaps = int((~inside & same_episode).sum())
    if gaps:
        found.append(
            Finding(
                "gaps",
                f"{gaps} gaps interrupt the episodes.",
                "No window goes over a gap; for the actuator, the last command is held in it. Log "
                "without losses if the path of the command matters.",
            )
        )
    for i, name in enumerate(system.action_names):
        if not float(samples.action[:, i].std()) > 0:
            found.append(
                Finding(
                    "excitation",
                    f"{name} never changes.",
                    "Nothing can be learned of what it does; record a motion that uses it.",
                )
            )
    return found + _velocities(system, samples)


def _beyond(task: Task, samples: Samples) -> list[Finding]:
    """Commands that the task does not allow, as those in a wrong unit are."""
    found = []
    low, high = task.bounds.low.to(samples.action), task.bounds.high.to(samples.action)
    slack = _SLACK * (high - low)
    for i, name in enumerate(task.system.action_names):
        given = samples.action[:, i]
        below, above = (given < low[i] - slack[i]), (given > high[i] + slack[i])
        share = float((below | above).double().mean())
        if share < _BEYOND:
            continue
        bounds = {"action_low": (below, low[i]), "action_high": (above, high[i])}
        passed = " or ".join(f"{n}={float(x):.4g}" for n, (out, x) in bounds.items() if out.any())
        found.append(
            Finding(
                "bounds",
                f"{name}: {100 * share:.0f} % of the commands are beyond {passed}; they go from "
                f"{float(given.min()):.4g} to {float(given.max()):.4g}.",
                "Check the unit and the scale of the column: with wrong ones, all constants are "
                "wrong too. If they are right, widen Task(action_low=..., action_high=...).",
            )
        )
    return found


def _velocities(system: System, samples: Samples) -> list[Finding]:
    """Velocities that are not the slope of their position, over ten samples."""
    found = []
    apart = min(10, len(samples.time) - 1)
    same = samples.stretch[apart:] == samples.stretch[:-apart]
    for position, velocity in system.velocity_of.items():
        q, v = (samples.state[:, system.state_names.index(name)] for name in (position, velocity))
        area = (v[1:] + v[:-1]) / 2 * samples.interval[:-1]
        whole = torch.cat([area.new_zeros(1), area.cumsum(0)])
        moved, expected = q[apart:] - q[:-apart], whole[apart:] - whole[:-apart]
        good = same & moved.isfinite() & expected.isfinite()
        if int(good.sum()) < 20:
            continue
        moved, expected = moved[good], expected[good]
        slope = float((moved * expected).sum() / expected.square().sum().clamp_min(1e-300))
        left = float((moved - expected).square().mean() / moved.square().mean().clamp_min(1e-300))
        if abs(slope - 1.0) > 0.1 and left > 0.05:
            found.append(
                Finding(
                    "velocity",
                    f"{velocity} is not the slope of {position}: {position} moves {slope:.3g} "
                    "times as far as it says.",
                    "Check units and sign of the column, or leave it out: velocities need not be "
                    "measured.",
                )
            )
    return found
