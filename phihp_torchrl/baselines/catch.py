"""The regulator that catches a model at its goal from furthest, and how far that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.energy import find_energy
from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.baselines.point import LinearModel, half_ranges, physical_step
from phihp_torchrl.baselines.take_over import TakeOver
from phihp_torchrl.config import ConfigError
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


_NONE = np.zeros((0, 0))
"""In the place of matrices that a difference to a point does not need."""


class Catch(TakeOver):
    r"""A regulator at the goal that takes over from another controller where it is near enough.

    It acts where the cost-to-go :math:`z^\top P z` of the regulator is below a level, by
    :math:`u = u_0 - K z`, and leaves all other states to whoever acted there. So plans have only to
    come near the goal; there the regulator holds it, without the noise of a search or its cost
    (dual-mode control: Michalska and Mayne, 1993, https://doi.org/10.1109/9.262032).

    Goal, gain, cost and level are its buffers, so it is saved with an agent's weights.

    Args:
        task: the task.
        moved: the registers of the task that belong to its state, by their places
            (:class:`~phihp_torchrl.baselines.point.LinearModel`).

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum-swingup")
        >>> catch = Catch.from_model(task, HybridDynamics.pure_prior(task))
        >>> states = torch.tensor([[0.01, 0.0], [torch.pi, 0.0]])
        >>> catch.near(states)
        tensor([ True, False])
        >>> held = catch(states, torch.full((2, 1), 2.0))
        >>> bool(held[0] < 0), held[1].item()
        (True, 2.0)
    """

    kind: ClassVar[str] = "goal"
    distance: ClassVar[str] = "level"

    at: Tensor
    keeping: Tensor
    gain: Tensor
    cost: Tensor
    level: Tensor

    def __init__(self, task: Task, moved: Sequence[int] = ()) -> None:
        size, actions = task.system.state_dim + len(moved), task.action_dim
        shapes = {
            "at": [size],
            "keeping": [actions],
            "gain": [actions, size],
            "cost": [size, size],
            "level": [],
        }
        super().__init__(task, moved, shapes)

    @classmethod
    def from_model(cls, task: Task, dynamics: nn.Module, share: float = 1.0) -> Catch:
        """Build it in a model: the regulator that catches from furthest, and its level.

        Args:
            task: the task, with a goal in which the model rests.
            dynamics: the model, ``(state, action) -> next state``.
            share: share of the level from which the model shows that the regulator arrives.

        Raises:
            ConfigError: where there is no regulator, as :meth:`LQR.from_model`, and where it
                arrives from nowhere.
        """
        lqr, level = find_catch(task, dynamics)
        if level <= 0:
            raise ConfigError("goal", "expected one at which a regulator arrives, got none.")
        made = cls(task, lqr.point.moved)
        made.at.copy_(lqr.point.state)
        made.keeping.copy_(lqr.point.action)
        made.gain.copy_(lqr.gain)
        made.cost.copy_(lqr.cost)
        made.level.fill_(share * level)
        return made

    def take(self, state: Tensor, starts: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Where it acts, bool ``[*batch]``, and its action ``[*batch, m]``."""
        error = self._error(state)
        return self._is_near(error), self._action(error)

    def near(self, state: Tensor) -> Tensor:
        """Whether it acts in a state of the task ``[*batch, n]``, bool ``[*batch]``."""
        return self._is_near(self._error(state))

    def act(self, state: Tensor) -> Tensor:
        """Its action in a state ``[*batch, n]``, within its bounds, ``[*batch, m]``."""
        return self._action(self._error(state))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Its action ``[*batch, m]`` in states that are near, and ``action`` in all others."""
        near, own = self.take(state)
        return torch.where(near.unsqueeze(-1), own, action)

    def _error(self, state: Tensor) -> Tensor:
        point = LinearModel(self.task, self.at, self.keeping, _NONE, _NONE, self.moved)
        return point.difference(state)

    def _is_near(self, error: Tensor) -> Tensor:
        return ((error @ self.cost.to(error)) * error).sum(-1) < self.level.to(error)

    def _action(self, error: Tensor) -> Tensor:
        return self.task.clip_action(self.keeping.to(error) - error @ self.gain.to(error).mT)


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
