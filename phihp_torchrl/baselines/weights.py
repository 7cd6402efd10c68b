"""Weights of a quadratic cost around a point: those of the reward, or one's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import hessian

from phihp_torchrl.baselines.point import LinearModel, Matrix, half_ranges
from phihp_torchrl.baselines.reference import followed, held
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task

_STATE_FLOOR = 0.01
"""The least weight of a half-range of the state, as a share of the largest weight."""
_ACTION_FLOOR = 0.1
"""The least weight of a full action: cheaper ones saturate near the goal and lose it sooner."""
_REACH = 0.05
"""Half-ranges to either side of two components together, in which curvatures of secants are."""


class Weights(NamedTuple):
    """Weights of a quadratic cost around a point, ``½ unit (z' Q z + u' R u)`` in reward.

    Args:
        q: weights of the state, ``[n, n]``.
        r: weights of the action, ``[m, m]``.
        unit: the reward that a cost of ½ stands for; 1 where the reward says nothing.
    """

    q: Matrix
    r: Matrix
    unit: float


def find_weights(
    task: Task,
    point: LinearModel,
    state_weights: Sequence[float] | None = None,
    action_weights: Sequence[float] | None = None,
) -> Weights:
    """The weights of the reward, or the diagonals that are given in place of them.

    Raises:
        ConfigError: for weights of the wrong number or sign.
    """
    weights = reward_weights(task, point)
    if state_weights is not None:
        q = np.diag(_checked("state_weights", state_weights, task.system.state_dim, zero=True))
        weights = weights._replace(q=q, unit=1.0)
    if action_weights is not None:
        r = np.diag(_checked("action_weights", action_weights, task.action_dim, zero=False))
        weights = weights._replace(r=r, unit=1.0)
    return weights


def reward_weights(task: Task, point: LinearModel) -> Weights:
    """Weights from the second derivative of the reward at a point, in physical units.

    A reward is written as ``reward(s, a, s)``, of a state that stays. Directions in which it curves
    upward count as flat.

    On a reference, which then has the values of the point, curvatures are secants across a tenth of
    the half-ranges: rewards of the size of an error have a kink there. If one is flat even so, what
    is to be followed weighs as much as the heaviest.
    """
    ranges, reach = half_ranges(task)
    state, action = point.state[: len(ranges)], point.action
    places = list(followed(task).values())

    def of_state(z: Tensor) -> Tensor:
        whole = held(task, state + ranges * z, state)
        return -task.earned(whole, action, whole)

    def of_action(u: Tensor) -> Tensor:
        whole = held(task, state, state)
        return -task.earned(whole, action + reach * u, whole)

    curvature = _secants if places else hessian
    q = _positive(curvature(of_state)(torch.zeros_like(state)))
    r = _positive(curvature(of_action)(torch.zeros_like(action)))
    unit = max(np.linalg.eigvalsh(q).max(), np.linalg.eigvalsh(r).max())
    if not unit > 1e-9:
        unit = 1.0
        if not places:
            q, r = np.eye(len(q)), np.eye(len(r))
    q = q / unit
    for place in places:
        if q[place, place] < _STATE_FLOOR:
            q[place, place] = 1.0
    q = q + _STATE_FLOOR * np.eye(len(q))
    r = r / unit + _ACTION_FLOOR * np.eye(len(r))
    across, along = ranges.numpy(), reach.numpy()
    return Weights(q / np.outer(across, across), r / np.outer(along, along), float(unit))


def _secants(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Second differences of a function, ``[n] -> [n, n]``, in the place of its hessian."""

    def curvature(at: Tensor) -> Tensor:
        ways = _REACH * torch.eye(len(at)).to(at)
        rows = [
            function(at + a + b)
            - function(at + a - b)
            - function(at - a + b)
            + function(at - a - b)
            for a in ways
            for b in ways
        ]
        return torch.stack(rows).unflatten(0, (len(at), len(at))) / (2.0 * _REACH) ** 2

    return curvature


def _positive(curvature: Tensor) -> Matrix:
    """The nearest symmetric matrix without negative eigenvalues; zero where it is not finite."""
    matrix = curvature.detach().double().numpy()
    if not np.isfinite(matrix).all():
        return np.zeros_like(matrix)
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * values.clip(0.0)) @ vectors.T


def _checked(name: str, given: Sequence[float], count: int, *, zero: bool) -> list[float]:
    values = [float(value) for value in given]
    good = all(value >= 0 if zero else value > 0 for value in values)
    if len(values) != count or not good:
        sign = "at least 0" if zero else "above 0"
        raise ConfigError(name, f"expected {count} numbers {sign}, got {tuple(given)}.")
    return values
