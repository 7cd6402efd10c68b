"""Lambda tuning of a PID loop from a linear model: every pole of the loop at -1/λ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from phihp_torchrl.baselines.point import LinearModel, Matrix
from phihp_torchrl.config import ConfigError

_PEAK = 1.7
"""The largest peak of the sensitivity that the fastest loop may have (a gain margin of 2.4)."""
_TIMES = np.geomspace(1.5, 200.0, 40)
"""Time constants that are tried, in time steps."""
_NOTHING = 1e-9
"""Effect of an action, per second, that is none."""
_DIRECT = 0.5
"""Share of the effect by the step response, below which that at once is not what is meant."""
_LONG = 5000
"""Steps in which a step response has to end."""


class Gains(NamedTuple):
    """Gains of one loop, in units of the action per unit of the component.

    Args:
        p: proportional gain.
        i: integral gain, per second.
        d: gain on the component's own velocity, in seconds; 0 where it has none.
        time_constant: λ, in seconds.
        peak: the largest sensitivity of the loop, max |1 / (1 + L)|.
    """

    p: float
    i: float
    d: float
    time_constant: float
    peak: float


def tune(
    point: LinearModel, component: str, action: str, time_constant: float | None = None
) -> Gains:
    r"""Tune the loop from one component of the state to one action.

    Of the component alone the model is first or second order:

    .. math:: \ddot y = -a_0 y - a_1 \dot y + b u

    and the gains put all poles of that loop at :math:`-1/\lambda` (lambda tuning, as a direct
    synthesis that also fits unstable plants). Each λ is then judged with the whole linear model,
    in discrete time and with the registers of an actuator: the shortest λ is taken whose loop is
    stable and whose sensitivity peaks below 1.7, or else the stable one with the lowest peak.

    A component without a velocity that the action moves mostly through another one, such as the
    speed of a motor through its current, is first order by its step response: its gain, and the
    time in which it does 63 % of its way.

    Args:
        point: the linear model at the set point.
        component: name of the component to be controlled.
        action: name of the action.
        time_constant: λ in seconds. Chosen by default.

    Raises:
        ConfigError: where the action does not move the component, or no λ gives a stable loop.
    """
    system, seconds = point.task.system, point.task.time_step
    y, u = system.state_names.index(component), system.action_names.index(action)
    velocity = system.velocity_of.get(component)
    v = None if velocity is None else system.state_names.index(velocity)
    strength, decay = _answer(point, component, u)
    if not abs(strength) > _NOTHING:
        raise ConfigError(
            "component", f"expected one that {action} moves, {component!r} does not answer to it."
        )
    tried = []
    times = _TIMES * seconds if time_constant is None else [time_constant]
    for time in times:
        # With a velocity (s + 1/λ)³ is wanted, without one (s + 1/λ)².
        if v is None:
            gains = (2.0 / time - decay, 1.0 / time**2, 0.0)
        else:
            pull, drag = -point.a[v, y] / seconds, (1.0 - point.a[v, v]) / seconds
            gains = (3.0 / time**2 - pull, 1.0 / time**3, 3.0 / time - drag)
        p, i, d = (float(gain) / strength for gain in gains)
        peak = _peak(point, (y, v, u), (p, i, d))
        if peak is not None:
            tried.append(Gains(p, i, d, float(time), peak))
            if peak <= _PEAK:
                break
    if not tried:
        raise ConfigError(
            "component",
            f"expected a loop that {action} can stabilise, that of {component!r} is unstable for "
            f"every time constant tried, {times[0]:.3g} s to {times[-1]:.3g} s.",
        )
    return min(tried, key=lambda gains: max(gains.peak, _PEAK))


def _answer(point: LinearModel, component: str, u: int) -> tuple[float, float]:
    """How an action moves a component or its velocity, and how these decay, both per second.

    A residual that was learned moves everything a little at once, so that a step response decides
    which way is meant.
    """
    system, seconds = point.task.system, point.task.time_step
    velocity = system.velocity_of.get(component)
    row = system.state_names.index(component if velocity is None else velocity)
    direct = _strength(point, row, u) / seconds
    if velocity is None:
        slow, decay = _slow(point, row, u)
        if abs(direct) < _DIRECT * abs(slow):
            return slow, decay
    return direct, (1.0 - point.a[row, row]) / seconds


def _strength(point: LinearModel, row: int, u: int) -> float:
    """The change of a component by a step of an action, once what is under way has arrived."""
    size = point.task.system.state_dim
    arrived = np.zeros(len(point.a))
    arrived[:size] = point.b[:size, u]
    # Registers move among themselves and do not decay to nothing while the command is held.
    inner, into = point.a[size:, size:], point.b[size:, u]
    if len(into):
        held = np.linalg.solve(np.eye(len(into)) - inner, into)
        arrived[:size] += point.a[:size, size:] @ held
    return float(arrived[row])


def _slow(point: LinearModel, y: int, u: int) -> tuple[float, float]:
    """Effect per second and decay per second of a first-order lag with the same step response.

    Both are 0 where the component does not come to rest.
    """
    state, response = np.zeros(len(point.a)), []
    for _ in range(_LONG):
        state = point.a @ state + point.b[:, u]
        response.append(state[y])
    way = np.array(response)
    ended = np.isfinite(way).all() and abs(way[-1] - way[_LONG // 2]) <= 1e-3 * abs(way[-1])
    if not ended or abs(way[-1]) <= _NOTHING:
        return 0.0, 0.0
    steps = 1 + int(np.argmax(way / way[-1] >= 1.0 - np.exp(-1.0)))
    decay = 1.0 / (steps * point.task.time_step)
    return float(way[-1]) * decay, decay


def _peak(
    point: LinearModel, places: tuple[int, int | None, int], gains: tuple[float, float, float]
) -> float | None:
    """The peak of the sensitivity of the loop; ``None`` if it is not stable.

    Modes that the component does not show, such as a cart's position, may do as they like.
    """
    (y, v, u), (p, i, d) = places, gains
    a, b, seconds = point.a, point.b[:, u], point.task.time_step
    n = len(a)
    back = np.zeros(n)
    back[y] = p
    if v is not None:
        back[v] += d
    closed = np.zeros((n + 1, n + 1))
    closed[:n, :n] = a - np.outer(b, back)
    closed[:n, n] = b
    closed[n, y], closed[n, n] = -seconds * i, 1.0
    values, vectors = np.linalg.eig(closed)
    seen = np.abs(vectors[y]) > 1e-6
    if (np.abs(values[seen]) >= 1.0 - 1e-9).any():
        return None
    circle = np.exp(1j * np.geomspace(1e-3, np.pi, 200))
    answers = np.linalg.solve(
        circle[:, None, None] * np.eye(n) - a, np.broadcast_to(b[:, None], (len(circle), n, 1))
    )[..., 0]
    loop = answers @ back + i * seconds / (circle - 1.0) * answers[:, y]
    return float((1.0 / np.abs(1.0 + loop)).max())


def pair(
    point: LinearModel, ranges: Matrix, components: Sequence[str] | None = None
) -> dict[str, str]:
    """The component that each action moves most, in units of its range; one for each action.

    Args:
        point: the linear model.
        ranges: half-range of each component.
        components: those that are to be controlled. By default all that are no velocities.
    """
    system = point.task.system
    own = [name for name in system.state_names if name not in system.velocity_of.values()]
    own = own if components is None else list(components)
    moved = {}
    for name in own:
        unit = ranges[system.state_names.index(name)]
        for j, action in enumerate(system.action_names):
            moved[name, action] = abs(_answer(point, name, j)[0]) / unit
    pairs: dict[str, str] = {}
    for (name, action), strength in sorted(moved.items(), key=lambda each: -each[1]):
        if strength > _NOTHING and action not in pairs and name not in pairs.values():
            pairs[action] = name
    return pairs
