"""The regulator that catches a model at its goal from furthest, and how far that is."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import nn

from phihp_torchrl.baselines.energy import find_energy
from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.baselines.point import half_ranges, physical_step
from phihp_torchrl.tasks import Task

_SAMPLES = 512
_MOST_STEPS = 200
_ARRIVED = 0.2
"""Half-ranges of the wide box, of every component, within which a regulator has arrived."""
_MISSES = 2.0
"""How many more states caught make up for one that is not."""
_EFFORTS = (1.0, 10.0)
"""Weights of a full action that are tried: dear actions saturate later, cheap ones are faster."""
_CART_EFFORTS = (10.0,)
"""Those for a cart: with cheap actions its regulator leans on learned friction."""


def find_catch(task: Task, dynamics: nn.Module) -> tuple[LQR, float]:
    """The regulator that catches the most of the states around the goal, and its level.

    Raises:
        ConfigError: where there is no regulator, as :meth:`LQR.from_model`.
    """
    tried = []
    reach, energy = half_ranges(task)[1], find_energy(task)
    carried = energy is not None and energy[0].carried
    for effort in _CART_EFFORTS if carried else _EFFORTS:
        weights = (effort / reach.square()).tolist()
        lqr = LQR.from_model(task, dynamics, action_weights=weights)
        level, share = catch_level(lqr, dynamics)
        tried.append((share, level, lqr))
    _, level, lqr = max(tried, key=lambda each: each[0])
    return lqr, level


@torch.no_grad()
def catch_level(lqr: LQR, dynamics: nn.Module, seed: int = 0) -> tuple[float, float]:
    """The cost-to-go that best parts the states from which the clipped regulator arrives.

    States around the goal at all distances up to the wide box are rolled out in the model. One that
    is below the level and did not arrive weighs as much as two that did. An actuator is left at
    rest at first.

    Args:
        lqr: the regulator.
        dynamics: the model, ``(state, action) -> next state``.
        seed: seed of the states.

    Returns:
        The level, and the share of the states tried that are below it, less those that it fails.
    """
    task, point = lqr.task, lqr.point
    like = next(iter([*dynamics.parameters(), *dynamics.buffers()]), torch.zeros(()))
    generator = torch.Generator().manual_seed(seed)
    ranges = half_ranges(task)[0]
    size = len(ranges)
    way = 2.0 * torch.rand([_SAMPLES, size], generator=generator, dtype=ranges.dtype) - 1.0
    far = 10.0 ** (-2.0 * torch.rand([_SAMPLES, 1], generator=generator, dtype=ranges.dtype))
    physical = (point.state[:size] + far * way * ranges).to(like)
    state = task.at_rest(physical)
    step = physical_step(dynamics)
    first = lqr.value(state)
    for _ in range(_steps(lqr)):
        state = task.transition(step, state, lqr.act(state)).next_state
    error = point.difference(state)[:, :size] / ranges.to(like)
    arrived = (error.abs() < _ARRIVED).all(-1)
    order = first.argsort()
    gained = torch.where(arrived[order], 1.0, -_MISSES).cumsum(0)
    best = gained.argmax()
    if gained[best] <= 0:
        return 0.0, 0.0
    return first[order][best].item(), gained[best].item() / _SAMPLES


def _steps(lqr: LQR) -> int:
    """Steps after which the slowest mode of the closed loop has decayed to a hundredth."""
    closed = lqr.point.a - lqr.point.b @ lqr.gain.cpu().numpy()
    slowest = float(np.abs(np.linalg.eigvals(closed)).max())
    steps = math.log(0.01) / math.log(slowest) if 0 < slowest < 1 else 1.0
    return max(50, min(_MOST_STEPS, math.ceil(steps)))
