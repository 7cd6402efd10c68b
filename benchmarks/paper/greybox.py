"""Plain grey-box fits with SciPy, as one writes them in an afternoon: what a log is worth to them.

Neither knows of a delay, a lag or a stop. Constants are fitted by their logarithms, to ``±5``
around the first guesses, with :func:`scipy.optimize.least_squares` and one RK4 step from sample to
sample. Derivatives are differences of simulations that run side by side in one array, so that the
time is that of NumPy and not that of a loop over parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from phihp_torchrl.recordings import Recording

Array = NDArray[np.float64]
Equations = Callable[[Sequence[Array], Array, Sequence[Array]], list[Array]]
"""Rates of the states, from the states, the action and the constants."""

GRAVITY = 9.81
_REACH = 5.0
_NUDGE = 1e-6
_TRIES = 40
"""Evaluations of the residuals at most."""
_FAR = 1e6
"""A simulation that left the numbers is so many spreads of its state off."""


def pendulum(state: Sequence[Array], volts: Array, constants: Sequence[Array]) -> list[Array]:
    """A rod on a geared motor with viscous and dry friction."""
    (angle, speed), (mass, length, gain, viscous, coulomb) = state, constants
    friction = viscous * speed + coulomb * np.tanh(speed / 0.02)
    torque = gain * volts - mass * GRAVITY * length / 2.0 * np.sin(angle) - friction
    return [speed, torque / (mass * length**2 / 3.0)]


def tanks(state: Sequence[Array], pump: Array, constants: Sequence[Array]) -> list[Array]:
    """Two tanks in a row."""
    area_1, area_2, outlet_1, outlet_2, flow = constants
    first, second = (np.sqrt(2.0 * GRAVITY * np.maximum(level, 1e-6)) for level in state)
    between = outlet_1 * first
    return [(flow * pump - between) / area_1, (between - outlet_2 * second) / area_2]


def rail(state: Sequence[Array], force: Array, constants: Sequence[Array]) -> list[Array]:
    """A cart with a pole, which hangs down at 0."""
    (_, v, theta, w), (cart, m, l, coulomb, viscous) = state, constants
    sin, cos, total = np.sin(theta), -np.cos(theta), cart + m
    push = force - coulomb * np.tanh(v / 0.005) + m * l * w**2 * sin
    pull = GRAVITY * sin + viscous * w / (m * l)
    turn = (pull - cos * push / total) / (l * (4.0 / 3.0 - m * cos**2 / total))
    return [v, push / total - m * l * turn * cos / total, w, -turn]


class Log(NamedTuple):
    """Stretches side by side, padded at their ends.

    Args:
        state: measured, NaN elsewhere, ``[S, L, n]``; velocities by differences in ``guess``.
        guess: states without NaN where their stretch has samples, ``[S, L, n]``.
        action: what is commanded, ``[S, L]``.
        seconds: to the next sample, 0 in the padding, ``[S, L]``.
        spread: standard deviation of each measured state, NaN for others, ``[n]``.
    """

    state: Array
    guess: Array
    action: Array
    seconds: Array
    spread: Array


def gather(recordings: Sequence[Recording], velocity_of: Mapping[int, int]) -> Log:
    """Put stretches side by side; velocities that are not measured are slopes of positions.

    Args:
        recordings: the stretches.
        velocity_of: index of the velocity of a position, by its index.
    """
    size = (len(recordings), max(len(r) for r in recordings))
    n = recordings[0].state.shape[1]
    state, guess = np.full((*size, n), np.nan), np.full((*size, n), np.nan)
    action, seconds = np.zeros(size), np.zeros(size)
    for i, r in enumerate(recordings):
        length, time = len(r), r.time.numpy()
        state[i, :length] = r.state.numpy()
        action[i, :length], seconds[i, : length - 1] = r.action[:, 0].numpy(), np.diff(time)
        for j in range(n):
            known = np.isfinite(state[i, :length, j])
            if known.any():
                guess[i, :length, j] = np.interp(time, time[known], state[i, :length, j][known])
        for position, velocity in velocity_of.items():
            if not np.isfinite(state[i, :, velocity]).any():
                guess[i, :length, velocity] = np.gradient(guess[i, :length, position], time)
    measured = np.isfinite(state).any((0, 1))
    spread = np.array([np.nanstd(state[..., j]) if measured[j] else np.nan for j in range(n)])
    return Log(state, guess, action, seconds, spread)


def step(
    rates: Equations, state: list[Array], action: Array, constants: Sequence[Array], dt: Array
) -> list[Array]:
    """One step of RK4, the action held."""

    def ahead(slope: Sequence[Array], share: float) -> list[Array]:
        return [s + share * dt * k for s, k in zip(state, slope, strict=True)]

    k1 = rates(state, action, constants)
    k2 = rates(ahead(k1, 0.5), action, constants)
    k3 = rates(ahead(k2, 0.5), action, constants)
    k4 = rates(ahead(k3, 1.0), action, constants)
    slopes = zip(k1, k2, k3, k4, strict=True)
    return ahead([(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in slopes], 1.0)


class Found(NamedTuple):
    """What a fit came to."""

    constants: Array
    message: str
    evaluations: int


def _solve(function: Any, start: Array, count: int, guess: Array, jacobian: Any) -> Found:
    """Least squares over the logarithms of constants, and what else is in ``start``."""
    far = np.full(len(start), np.inf)
    far[:count] = _REACH
    with np.errstate(all="ignore"):
        found = least_squares(
            function, start, jac=jacobian, bounds=(-far, far), x_scale="jac", max_nfev=_TRIES
        )
    return Found(guess * np.exp(found.x[:count]), found.message, int(found.nfev))


def single_shooting(rates: Equations, log: Log, guess: Array) -> Found:
    """Simulate each stretch as a whole, from a start that is fitted too."""
    stretches, length, n = log.state.shape
    count = len(guess)
    starts = np.nan_to_num(log.guess[:, 0]) / _units(log)
    known = np.isfinite(log.state) & np.isfinite(log.spread)

    def simulate(change: Array, first: Array) -> Array:
        """Of ``[K, p]`` and ``[K, S, n]``, the residuals ``[K, S, L, n]``."""
        constants = [c[:, None] for c in (guess * np.exp(change)).T]
        state = [np.array(x) for x in np.moveaxis(first * _units(log), -1, 0)]
        path = np.empty((len(change), length, stretches, n))
        for t in range(length):
            path[:, t] = np.stack(state, -1)
            state = step(rates, state, log.action[:, t], constants, log.seconds[:, t])
        off = (path.swapaxes(1, 2) - np.nan_to_num(log.state)) / log.spread
        return np.clip(np.nan_to_num(off, nan=_FAR, posinf=_FAR, neginf=-_FAR), -_FAR, _FAR)

    def residual(x: Array) -> Array:
        first = x[count:].reshape(1, stretches, n)
        return simulate(x[None, :count], first)[0][known]

    def jacobian(x: Array) -> Array:
        nudges = _NUDGE * np.eye(count + n)
        nudges = np.concatenate([nudges, -nudges])
        first = x[count:].reshape(1, stretches, n) + nudges[:, None, count:]
        off = simulate(x[:count] + nudges[:, :count], first)
        slopes = (off[: count + n] - off[count + n :]) / (2.0 * _NUDGE)
        columns = np.zeros((int(known.sum()), len(x)))
        columns[:, :count] = slopes[:count, known].T
        for s in range(stretches):  # a start moves its own stretch alone
            mine = np.zeros_like(known)
            mine[s] = known[s]
            rows = mine[known]
            columns[rows, count + s * n : count + (s + 1) * n] = slopes[count:, mine].T
        return columns

    start = np.concatenate([np.zeros(count), starts.ravel()])
    return _solve(residual, start, count, guess, jacobian)


def in_pieces(recordings: Sequence[Recording], longest: int = 50) -> list[Recording]:
    """The same samples, cut into stretches of at most so many."""
    return [
        Recording(r.time[a : a + longest], r.state[a : a + longest], r.action[a : a + longest])
        for r in recordings
        for a in range(0, len(r) - 1, longest)
        if len(r) - a > 1
    ]


def one_step(rates: Equations, log: Log, guess: Array) -> Found:
    """Predict each sample from the one before, velocities taken by differences."""
    before, after = log.guess[:, :-1], log.guess[:, 1:]
    measured = np.isfinite(log.state).any((0, 1))
    seen = np.logical_and.reduce(np.isfinite(log.state) | ~measured, axis=-1)
    good = seen[:, :-1] & seen[:, 1:] & (log.seconds[:, :-1] > 0)
    action, seconds = log.action[:, :-1][good], log.seconds[:, :-1][good]
    state, target = list(before[good].T), after[good].T
    change = (target - before[good].T).std(1)[:, None]

    def residual(x: Array) -> Array:
        ahead = step(rates, state, action, list(guess * np.exp(x)), seconds)
        return np.nan_to_num(((np.stack(ahead) - target) / change).ravel(), nan=_FAR)

    return _solve(residual, np.zeros(len(guess)), len(guess), guess, "2-point")


def _units(log: Log) -> Array:
    """Sizes of the states, so that starts are numbers near one."""
    return np.nanstd(log.guess, axis=(0, 1))
