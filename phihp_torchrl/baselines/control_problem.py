"""A task in a model as a problem of optimal control: costs, rollouts, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import grad, jvp

from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.baselines.point import physical_step
from phihp_torchrl.baselines.weights import reward_weights
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task, Transition

_SAMPLES = 256
"""States of the wide box from which the spread of the reward is known."""


class Trajectory(NamedTuple):
    """A rollout of a batch of rows.

    Args:
        states: ``[H + 1, *batch, n]``, registers included.
        actions: in units of the bounds, -1 to 1, ``[H, *batch, m]``.
        cost: the cost of all steps and of the last state, ``[*batch]``; infinite where it is not
            finite.
    """

    states: Tensor
    actions: Tensor
    cost: Tensor


class Expansion(NamedTuple):
    """The problem around a trajectory, to second order in cost and to first in dynamics.

    Args:
        slope: derivative of the next state by state and action, ``[H, N, n, n + m]``.
        gradient: derivative of a step's cost by state and action, ``[H, N, n + m]``.
        curvature: its second derivative without negative eigenvalues, ``[H, N, n + m, n + m]``.
        last_gradient: derivative of the last state's cost, ``[N, n]``.
        last_curvature: its second derivative, ``[N, n, n]``.
    """

    slope: Tensor
    gradient: Tensor
    curvature: Tensor
    last_gradient: Tensor
    last_curvature: Tensor


class ControlProblem(nn.Module):
    """Costs and dynamics of a task in a model, in units of the bounds and of the reward's spread.

    A step costs the negative of its reward with the prices of the task; where the reward is flat in
    the whole wide box, as one for staying alive, it costs what the regulator at the goal weighs.
    The last state costs the regulator's cost-to-go. Ends of an episode are ignored.

    Args:
        task: the task.
        dynamics: the model, ``(state, action) -> next state``.
        lqr: the regulator at the goal; ``None`` where the task has no goal, and the last state
            costs nothing.
        reason: why there is no regulator.

    Raises:
        ConfigError: for a task without a goal whose reward is flat, so that its derivative says
            nothing.
    """

    center: Tensor
    scale: Tensor

    def __init__(
        self, task: Task, dynamics: nn.Module, lqr: LQR | None, reason: str = "unknown"
    ) -> None:
        super().__init__()
        self.task, self.dynamics, self.lqr = task, dynamics, lqr
        spread, flat = _spread(task)
        self.weights = None
        if flat:
            if lqr is None:
                raise ConfigError(
                    "reward",
                    f"expected one that changes with the state, or a task with a goal: that of "
                    f"{task.name!r} has no slope anywhere, and there is no goal: {reason}",
                )
            found = reward_weights(task, lqr.point)
            self.weights = torch.as_tensor(found.q), torch.as_tensor(found.r)
            spread = 1.0
        self.spread = spread
        self.register_buffer("center", task.bounds.center)
        self.register_buffer("scale", task.bounds.scale)

    def physical(self, unit: Tensor) -> Tensor:
        """Actions ``[*batch, m]`` in physical units, from units of the bounds."""
        return self.center.to(unit) + self.scale.to(unit) * unit

    def unit(self, action: Tensor) -> Tensor:
        """Actions ``[*batch, m]`` in units of the bounds, clipped to them."""
        return ((action - self.center.to(action)) / self.scale.to(action)).clamp(-1.0, 1.0)

    def move(self, state: Tensor, unit: Tensor) -> Transition:
        """One step of the task."""
        return self.task.transition(physical_step(self.dynamics), state, self.physical(unit))

    def pay(self, state: Tensor, unit: Tensor, next_state: Tensor) -> Tensor:
        """The cost of a step, ``[*batch]``."""
        action = self.physical(unit)
        if self.weights is not None:
            assert self.lqr is not None
            point = self.lqr.point
            q, r = (weight.to(state) for weight in self.weights)
            size = len(q)
            z = self.task.difference(state[..., :size], point.state[:size].to(state))
            u = action - point.action.to(state)
            return 0.5 * (((z @ q) * z).sum(-1) + ((u @ r) * u).sum(-1))
        registers = self.task.split(state)[1]
        command = self.task.command(registers, action)
        earned = self.task.earned(state, command, next_state)
        price = self.task.price(state, action, next_state)
        return ((0.0 if price is None else price) - earned) / self.spread

    def pay_last(self, state: Tensor) -> Tensor:
        """The cost of the last state, ``[*batch]``."""
        if self.lqr is None:
            return torch.zeros_like(state[..., 0])
        return 0.5 * self.lqr.unit / self.spread * self.lqr.value(state)

    def difference(self, state: Tensor, other: Tensor) -> Tensor:
        """``state - other`` with registers, of angles on the circle, ``[*batch, n]``."""
        (physical, registers), (at, under_way) = self.task.split(state), self.task.split(other)
        return torch.cat([self.task.difference(physical, at), registers - under_way], -1)

    def roll(self, state: Tensor, act: Callable[[int, Tensor], Tensor], steps: int) -> Trajectory:
        """Roll out a law of control, ``(step, state [*batch, n]) -> action`` in units."""
        states, actions, earned = [state], [], torch.zeros_like(state[..., 0])
        for k in range(steps):
            actions.append(act(k, states[-1]).clamp(-1.0, 1.0))
            moved = self.move(states[-1], actions[-1])
            states.append(moved.next_state)
            earned = earned + moved.reward
        cost = -earned / self.spread
        if self.weights is not None:
            whole = torch.stack(states)
            cost = self.pay(whole[:-1], torch.stack(actions), whole[1:]).sum(0)
        cost = cost + self.pay_last(states[-1])
        cost = torch.where(cost.isfinite(), cost, torch.inf)
        return Trajectory(torch.stack(states), torch.stack(actions), cost)

    def expand(self, trajectory: Trajectory) -> Expansion:
        """The problem around a trajectory of rows ``[N]``, by forward differentiation.

        Second derivatives of the dynamics are left out, which makes the method of Gauss and Newton
        of Newton's; where the cost curves downwards, it counts as flat.
        """
        states, actions, _ = trajectory
        n, m = states.shape[-1], actions.shape[-1]
        both = torch.cat([states[:-1], actions], -1)
        _, slope = _columns(lambda z: self.move(z[..., :n], z[..., n:]).next_state, both)

        def pay(z: Tensor) -> Tensor:
            return self.pay(z[..., :n], z[..., n : n + m], z[..., n + m :]).sum()

        gradient, curvature = _columns(grad(pay), torch.cat([both, states[1:]], -1))
        same = torch.eye(n + m).to(both).expand(*slope.shape[:-2], -1, -1)
        chain = torch.cat([same, slope], -2)
        last, last_curvature = _columns(grad(lambda s: self.pay_last(s).sum()), states[-1])
        return Expansion(
            slope,
            (chain.mT @ gradient.unsqueeze(-1)).squeeze(-1),
            _positive(chain.mT @ curvature @ chain),
            last,
            last_curvature,
        )


def _columns(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """A function's value ``[*batch, p]`` and its Jacobian ``[*batch, p, q]``, at ``[*batch, q]``.

    Rows are differentiated together, a column at a time in one batch, so that the function need not
    allow :func:`torch.vmap`.
    """
    size = at.shape[-1]
    ways = torch.eye(size).to(at).reshape(size, *[1] * (at.ndim - 1), size)
    many, ways = at.repeat(size, *[1] * at.ndim), ways.repeat(1, *at.shape[:-1], 1)
    found = jvp(function, (many,), (ways,))
    return found[0][0], found[1].movedim(0, -1)


def _positive(matrix: Tensor) -> Tensor:
    """The nearest symmetric matrices without negative eigenvalues; zero where not finite."""
    matrix = (matrix + matrix.mT) / 2
    values, vectors = torch.linalg.eigh(torch.where(matrix.isfinite(), matrix, 0.0))
    return (vectors * values.clamp(min=0.0).unsqueeze(-2)) @ vectors.mT


def _spread(task: Task) -> tuple[float, bool]:
    """The spread of the reward in the wide box, and whether it has no slope there at all."""
    box = task.coverage or task.reset
    generator = torch.Generator().manual_seed(0)
    states = task.at_rest(box.sample([_SAMPLES], generator=generator))
    actions = task.bounds.center.expand(_SAMPLES, -1)

    def earned(state: Tensor) -> Tensor:
        return task.earned(state, actions, state).sum()

    spread = task.earned(states, actions, states).std().item()
    flat = bool((grad(earned)(states) == 0.0).all())
    return (spread if spread > 0 else 1.0), flat
