r"""A Kalman filter and Rauch-Tung-Striebel smoother of one position, with white jerk.

The position is taken to be measured with white noise of variance r, and to have a jerk that is
white noise of intensity q: between two samples, the acceleration is a random walk. That suits a
system whose commands are held for a step, because its acceleration jumps from step to step and its
velocity does not.

.. math::
    \frac{d}{dt}(x, v, a) = (v, a, w), \qquad z_k = x(t_k) + \epsilon_k, \qquad
    \mathrm{E}\,w(t)w(t') = q\,\delta(t - t'), \qquad \mathrm{Var}\,\epsilon = r

The estimate is the mean of the states given *all* samples (Rauch, Tung and Striebel, 1965), exact
for any spacing of the samples and with missing ones. It equals a quintic smoothing spline (Wahba,
1978). The ratio q/r is where the likelihood of the samples is largest, and r follows from it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_DIFFUSE = 1e10
"""Variance of the unknown first state, in units of r and of the unit of time."""


class Series(NamedTuple):
    """Times and measured positions, float64 ``[T]`` each; NaN where a position is missing."""

    time: NDArray[Any]
    position: NDArray[Any]


class Filtered(NamedTuple):
    """The result of :func:`filter_forward`, for r = 1.

    Args:
        log_size: sum of the logarithms of the variances of the innovations.
        squares: sum of the squared innovations over their variances.
        known: number of innovations.
        innovations: innovations over their standard deviations ``[T]``; NaN where there is none.
        history: at each sample, mean and covariance before and after it, ``[T, 18]``.
    """

    log_size: float
    squares: float
    known: int
    innovations: NDArray[Any]
    history: NDArray[Any]


def filter_forward(
    series: Series, jumps: NDArray[Any], unit: float, ratio: float, *, keep: bool = False
) -> Filtered:
    """Filter a series with r = 1 and q = ``ratio``.

    Args:
        series: times and positions.
        jumps: whether the velocity may jump before a sample, bool ``[T]``.
        unit: unit of time in seconds, in which the ratio is.
        ratio: q/r.
        keep: whether the history is returned.
    """
    intervals = (np.diff(series.time, prepend=series.time[0]) / unit).tolist()
    positions, resets = series.position.tolist(), jumps.tolist()
    x, v, a = float(series.position[np.isfinite(series.position)][0]), 0.0, 0.0
    xx, xv, xa, vv, va, aa = _DIFFUSE, 0.0, 0.0, _DIFFUSE, 0.0, _DIFFUSE
    log_size = squares = 0.0
    count, unknown = 0, 3
    innovations = np.full(len(positions), np.nan)
    rows: list[tuple[float, ...]] = []
    for k, (z, t) in enumerate(zip(positions, intervals, strict=True)):
        if k:  # the motion over an interval t, and its noise
            h, s = 0.5 * t * t, t * t
            x, v = x + t * v + h * a, v + t * a
            xx += 2 * (t * xv + h * xa + t * h * va) + s * vv + h * h * aa + ratio * t**5 / 20
            xv += t * (vv + xa) + (h + s) * va + t * h * aa + ratio * t**4 / 8
            xa += t * va + h * aa + ratio * t**3 / 6
            vv += 2 * t * va + s * aa + ratio * t**3 / 3
            va += t * aa + ratio * s / 2
            aa += ratio * t
            if resets[k]:
                vv, aa, unknown = vv + _DIFFUSE, aa + _DIFFUSE, max(unknown, 2)
        if keep:
            before = (x, v, a, xx, xv, xa, vv, va, aa)
        if z == z:  # measured
            size, error = xx + 1.0, z - x
            gx, gv, ga = xx / size, xv / size, xa / size
            x, v, a = x + gx * error, v + gv * error, a + ga * error
            vv, va, aa = vv - gv * xv, va - gv * xa, aa - ga * xa
            xx, xv, xa = gx, gv, ga  # (1 - gx) times what they were
            if unknown:  # what is unknown is learned first, and has no part in the likelihood
                unknown -= 1
            else:
                innovations[k] = error / math.sqrt(size)
                squares += error * error / size
                log_size += math.log(size)
                count += 1
        if keep:
            rows.append((*before, x, v, a, xx, xv, xa, vv, va, aa))
    return Filtered(log_size, squares, count, innovations, np.array(rows))


def backward(series: Series, filtered: Filtered, unit: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Smooth what was filtered: means of (x, v, a) ``[T, 3]`` and variances of v ``[T]``, r = 1."""
    t = np.diff(series.time) / unit
    move = np.broadcast_to(np.eye(3), (len(t), 3, 3)).copy()
    move[:, 0, 1] = move[:, 1, 2] = t
    move[:, 0, 2] = 0.5 * t * t
    rows = filtered.history
    ahead, spread, here, cover = (
        rows[:, :3],
        _full(rows[:, 3:9]),
        rows[:, 9:12],
        _full(rows[:, 12:]),
    )
    gains = np.linalg.solve(spread[1:], move @ cover[:-1]).swapaxes(-1, -2)
    path, variance = np.zeros((len(rows), 3)), np.zeros(len(rows))
    mean, certainty = here[-1], cover[-1]
    path[-1], variance[-1] = mean, certainty[1, 1]
    for k in range(len(rows) - 2, -1, -1):
        mean = here[k] + gains[k] @ (mean - ahead[k + 1])
        certainty = cover[k] + gains[k] @ (certainty - spread[k + 1]) @ gains[k].T
        path[k], variance[k] = mean, certainty[1, 1]
    return path, np.maximum(variance, 0.0)


def _full(parts: NDArray[Any]) -> NDArray[Any]:
    """Symmetric matrices ``[T, 3, 3]`` from their upper halves ``[T, 6]``."""
    return parts[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
