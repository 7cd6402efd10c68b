"""Velocities that were not measured, from the positions that were."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings.kalman import Series, backward, filter_forward
from phihp_torchrl.recordings.recording import Recording
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)

_ENOUGH = 5000
"""Samples from which the ratio is chosen; more do not change it."""

_LEAST = 5
"""Measured positions that a recording needs for velocities."""

_GRID = np.linspace(-9.0, 5.0, 15)  # log10 of q/r in the unit of the median interval
_JUMP = 6.0  # an innovation of so many standard deviations is a jump of the velocity
_ROUNDS = 5  # of looking for jumps
_FINEST = 0.1  # decades to which the ratio is searched


class Smoothness(NamedTuple):
    """What the smoother found for one position.

    Args:
        noise: standard deviation of the measurements, in the unit of the position.
        jerk: square root of the intensity q, in the unit of the position and seconds.
        velocity_error: standard deviation of the velocities, the root mean square over samples.
        jumps: samples around which the velocity jumps, as at a stop.
    """

    noise: float
    jerk: float
    velocity_error: float
    jumps: int


@dataclass(frozen=True)
class EstimatedVelocities:
    """The result of :func:`estimate_velocities`.

    Args:
        recordings: the recordings, with velocities.
        found: noise levels by the name of the position whose velocity was estimated.

    Examples:
        >>> EstimatedVelocities([], {}).notes()
        []
    """

    recordings: list[Recording]
    found: dict[str, Smoothness]

    def notes(self) -> list[str]:
        """A sentence for each estimated velocity, with the parameters of its smoother."""
        sentences = []
        for name, s in self.found.items():
            sentences.append(
                f"{name}: its velocity is estimated by a Rauch-Tung-Striebel smoother with white "
                f"jerk (sensor noise {s.noise:.3g}, jerk {s.jerk:.3g}, chosen by likelihood), to a "
                f"standard deviation of {s.velocity_error:.3g}."
            )
            if s.jumps:
                sentences[-1] += (
                    f" The velocity jumps at {s.jumps} samples, as at a stop, and is left unknown "
                    "around them."
                )
        return sentences


def estimate_velocities(
    recordings: Recording | Sequence[Recording],
    system: System | Task,
    *,
    smooth_positions: bool = False,
    keep_jumps: bool = False,
) -> EstimatedVelocities:
    """Estimate the velocities that no recording has measured.

    Each recording is smoothed by itself, so that nothing is bridged; the noise levels are chosen
    from all of them. Recordings with fewer than five measured positions get no velocities (NaN).

    A smoother spreads a velocity that jumps, as where a cart hits a stop, over the samples around
    the jump. Where the innovations say that the velocity jumps, the smoother starts anew, and the
    velocities of the two samples beside the jump are left unknown (NaN). A jump that is small
    against the noise is not seen.

    Args:
        recordings: recordings of one rig.
        system: the system, or a task on it.
        smooth_positions: whether the positions are replaced by smoothed ones as well, which also
            fills those that are missing.
        keep_jumps: whether jumps are smoothed over like everything else.

    Returns:
        The recordings with velocities, and what was found of each position.

    Raises:
        ConfigError: if no recording has enough samples of a position whose velocity is missing.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> time = 0.05 * torch.arange(200, dtype=torch.float64)
        >>> generator = torch.Generator().manual_seed(0)
        >>> noise = 0.001 * torch.randn(200, generator=generator, dtype=torch.float64)
        >>> state = torch.stack([time.sin() + noise, torch.full_like(time, torch.nan)], -1)
        >>> log = Recording(time, state, torch.zeros(200, 1))
        >>> estimate = estimate_velocities(log, get_task("pendulum"))
        >>> error = (estimate.recordings[0].state[:, 1] - time.cos())[10:-10]  # not at the ends
        >>> bool(error.abs().max() < 0.02), 0.0005 < estimate.found["theta"].noise < 0.002
        (True, True)
    """
    if isinstance(system, Task):
        system = system.system
    logs = [recordings] if isinstance(recordings, Recording) else list(recordings)
    index = system.state_names.index
    states = [log.state.numpy().copy() for log in logs]
    found: dict[str, Smoothness] = {}
    for position, velocity in system.velocity_of.items():
        q, v = index(position), index(velocity)
        if any(np.isfinite(state[:, v]).any() for state in states):
            continue
        series = [
            Series(log.time.numpy(), state[:, q])
            for log, state in zip(logs, states, strict=True)
            if np.isfinite(state[:, q]).sum() >= _LEAST
        ]
        if not series:
            raise ConfigError(
                "recordings",
                f"expected at least {_LEAST} measured samples of {position!r} in a recording, to "
                f"estimate {velocity!r} from; there are none.",
            )
        smoothed, found[position] = _smooth(series, keep_jumps)
        results = iter(smoothed)
        for state in states:
            if np.isfinite(state[:, q]).sum() >= _LEAST:
                path = next(results)
                state[:, v] = path[:, 1]
                if smooth_positions:
                    state[:, q] = path[:, 0]
    changed = [
        replace(log, state=torch.from_numpy(state)) for log, state in zip(logs, states, strict=True)
    ]
    estimate = EstimatedVelocities(changed, found)
    for note in estimate.notes():
        _log.info("%s", note)
    return estimate


def _smooth(series: list[Series], keep_jumps: bool) -> tuple[list[NDArray[Any]], Smoothness]:
    """Smooth all series with the likeliest noise levels; paths ``[T, 3]`` and what was found."""
    unit = float(np.median(np.concatenate([np.diff(s.time) for s in series])))
    jumps = [np.zeros(len(s.time), dtype=bool) for s in series]
    ratio, noise = _choose(series, jumps, unit, _GRID)
    for _ in range(0 if keep_jumps else _ROUNDS):  # without its jumps a motion is smoother
        more = [j | _jumps(s, j, unit, ratio, noise) for s, j in zip(series, jumps, strict=True)]
        if all(np.array_equal(a, b) for a, b in zip(more, jumps, strict=True)):
            break
        jumps = more
        ratio, noise = _choose(series, jumps, unit, np.log10(ratio) + np.linspace(-2.0, 1.0, 7))
    paths, variances = [], []
    for each, jump in zip(series, jumps, strict=True):
        path, variance = backward(each, filter_forward(each, jump, unit, ratio, keep=True), unit)
        path = path / unit ** np.arange(3)
        # The jump is somewhere between a sample and the one before.
        beside = jump | np.append(jump[1:], False)
        path[beside, 1:] = np.nan
        paths.append(path)
        variances.append(variance[~beside] * noise / unit**2)
    return paths, Smoothness(
        noise=float(np.sqrt(noise)),
        jerk=float(np.sqrt(ratio * noise / unit**5)),
        velocity_error=float(np.sqrt(np.concatenate(variances).mean())),
        jumps=int(sum(jump.sum() for jump in jumps)),
    )


def _choose(
    series: list[Series], jumps: list[NDArray[Any]], unit: float, grid: NDArray[Any]
) -> tuple[float, float]:
    """The likeliest ratio q/r, and r; the search begins on a grid of log10 q/r."""
    order = sorted(range(len(series)), key=lambda i: -len(series[i].time))
    chosen, count = [], 0
    for i in order:
        if count < _ENOUGH:
            part = slice(0, _ENOUGH - count)
            chosen.append((Series(series[i].time[part], series[i].position[part]), jumps[i][part]))
            count += len(series[i].time)
    step = float(grid[1] - grid[0])
    while True:
        found = [_likelihood(chosen, unit, float(10.0**each)) for each in grid]
        best = max(range(len(grid)), key=lambda i: found[i][0])
        if step < _FINEST:
            return float(10.0 ** grid[best]), found[best][1]
        step /= 4.0
        grid = grid[best] + step * np.arange(-3, 4)


def _likelihood(
    chosen: list[tuple[Series, NDArray[Any]]], unit: float, ratio: float
) -> tuple[float, float]:
    """Logarithm of the likelihood with r at its best, up to a constant; and that r."""
    filtered = [filter_forward(series, jumps, unit, ratio) for series, jumps in chosen]
    count = max(1, sum(f.known for f in filtered))
    noise = max(sum(f.squares for f in filtered) / count, float(np.finfo(float).tiny))
    return -0.5 * (sum(f.log_size for f in filtered) + count * math.log(noise)), noise


def _jumps(
    series: Series, jumps: NDArray[Any], unit: float, ratio: float, noise: float
) -> NDArray[Any]:
    """Samples before which the velocity jumps: the first of a run of large innovations."""
    large = np.abs(filter_forward(series, jumps, unit, ratio).innovations) > _JUMP * noise**0.5
    return large & ~np.concatenate([[False], large[:-1]])
