"""The linear-quadratic regulator of a model at a task's goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import LinAlgError, solve_discrete_are
from torch import Tensor, nn
from torch.func import hessian

from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.point import LinearModel, Matrix, half_ranges, linearise
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task

_STATE_FLOOR = 0.01
"""The least weight of a half-range of the state, as a share of the largest weight."""
_ACTION_FLOOR = 0.1
"""The least weight of a full action: cheaper ones saturate near the goal and lose it sooner."""


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


class LQR(Controller):
    r"""The linear-quadratic regulator at the task's goal: :math:`u = u_0 - K (s - s_0)`.

    The model's one step is linearised, by secants across a tenth of the half-ranges of the state,
    and K solves the discrete algebraic Riccati equation by :func:`scipy.linalg.solve_discrete_are`.
    The weights are the second derivative of the reward at the goal. In units of the half-range of
    the task's wide box every component has at least 1 % of the largest, and in units of its bounds
    every action 10 %: a reward that does not price an action, or is constant as CartPole's, still
    needs finite gains.

    It knows nothing of bounds, stops and the end of an episode: the action is clipped, and far from
    the goal it may fail. The registers of an actuator belong to its state, so that dead time and
    lag are reckoned with; where the actuator has a dead zone or a slew limit, whose derivative at
    rest is none, it uses the physical components alone and acts as if commands arrived at once.

    Args:
        point: the linear model, whose state and action are the goal.
        gain: K, ``[m, n]``.
        cost: P of the cost-to-go :math:`z^\top P z`, ``[n, n]``.
        unit: the reward that a cost of ½ stands for.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> lqr = LQR.from_model(task, HybridDynamics.pure_prior(task))
        >>> leaning = task.observe(torch.tensor([[0.1, 0.0], [-0.1, 0.0]]))
        >>> action = lqr(TensorDict(observation=leaning, batch_size=[2]))["action"]
        >>> action.shape, bool(action[0] < 0 < action[1])
        (torch.Size([2, 1]), True)
    """

    gain: Tensor
    cost: Tensor

    def __init__(self, point: LinearModel, gain: Matrix, cost: Matrix, unit: float = 1.0) -> None:
        super().__init__(point.task)
        self.point = point
        self.unit = unit
        self.register_buffer("gain", torch.as_tensor(gain))
        self.register_buffer("cost", torch.as_tensor(cost))

    @classmethod
    def from_model(
        cls,
        task: Task,
        dynamics: nn.Module,
        *,
        goal: Sequence[float] | None = None,
        state_weights: Sequence[float] | None = None,
        action_weights: Sequence[float] | None = None,
    ) -> LQR:
        """Build it for a task in a model.

        Args:
            task: the task.
            dynamics: the model, ``(state, action) -> next state``.
            goal: the state to keep, without registers. Defaults to the task's goal.
            state_weights: diagonal of Q for the physical components, in place of the reward's.
            action_weights: diagonal of R, in place of the reward's.

        Raises:
            ConfigError: where the task has no goal in which the model rests, for weights of the
                wrong number or sign, and where the action cannot stabilise the goal; the message
                names the component that it does not reach.
        """
        point = linearise(task, dynamics, goal, registers=is_smooth(task))
        weights = reward_weights(task, point)
        n, m = task.system.state_dim, task.action_dim
        q, r = weights.q, weights.r
        unit = weights.unit
        if state_weights is not None:
            q, unit = np.diag(_checked("state_weights", state_weights, n, zero=True)), 1.0
        if action_weights is not None:
            r, unit = np.diag(_checked("action_weights", action_weights, m, zero=False)), 1.0
        whole = np.zeros_like(point.a)
        whole[:n, :n] = q
        if lost := unstabilisable(point):
            names = ", ".join(task.system.action_names)
            raise ConfigError(
                "dynamics",
                f"expected a model that can be stabilised at the goal, but {names} does not reach "
                f"the mode of {lost}; another goal or more actions are needed.",
            )
        try:
            cost = solve_discrete_are(point.a, point.b, whole, r)
        except (LinAlgError, ValueError) as error:
            raise ConfigError(
                "dynamics", f"expected a Riccati equation with a solution at the goal: {error}"
            ) from error
        weighed = point.b.T @ cost
        gain = np.linalg.solve(r + weighed @ point.b, weighed @ point.a)
        return cls(point, gain, cost, unit)

    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        return self.point.action.to(state) - self._error(state) @ self.gain.to(state).mT

    def value(self, state: Tensor) -> Tensor:
        """The cost-to-go of the unbounded regulator, ``[*batch]``, in units of its weights."""
        error = self._error(state)
        return ((error @ self.cost.to(state)) * error).sum(-1)

    def _error(self, state: Tensor) -> Tensor:
        return self.point.difference(state[..., : len(self.point.state)])


def reward_weights(task: Task, point: LinearModel) -> Weights:
    """Weights from the second derivative of the reward at the goal, in physical units.

    A reward is written as ``reward(s, a, s)``, of a state that stays. Directions in which it curves
    upward count as flat.
    """
    ranges, reach = half_ranges(task)
    state, action = task.split(point.state)[0], point.action

    def of_state(z: Tensor) -> Tensor:
        s = state + ranges * z
        return -task.reward(s, action, s)

    def of_action(u: Tensor) -> Tensor:
        return -task.reward(state, action + reach * u, state)

    q = _positive(hessian(of_state)(torch.zeros_like(state)))
    r = _positive(hessian(of_action)(torch.zeros_like(action)))
    unit = max(np.linalg.eigvalsh(q).max(), np.linalg.eigvalsh(r).max())
    if not unit > 1e-9:
        q, r, unit = np.eye(len(q)), np.eye(len(r)), 1.0
    q = q / unit + _STATE_FLOOR * np.eye(len(q))
    r = r / unit + _ACTION_FLOOR * np.eye(len(r))
    across, along = ranges.numpy(), reach.numpy()
    return Weights(q / np.outer(across, across), r / np.outer(along, along), float(unit))


def unstabilisable(point: LinearModel) -> str:
    """The component that most moves in a mode which neither decays nor obeys; empty if none does.

    By the test of Popov, Belevitch and Hautus: a mode of a modulus of 1 or more needs
    ``[A - λ I, B]`` of full rank. Units are half-ranges.
    """
    ranges, reach = (part.numpy() for part in half_ranges(point.task))
    extra = len(point.a) - len(ranges)
    ranges = np.concatenate([ranges, np.ones(extra)])
    a = point.a * ranges[None] / ranges[:, None]
    b = point.b * reach[None] / ranges[:, None]
    for eigenvalue in np.linalg.eigvals(a):
        if abs(eigenvalue) < 1.0 - 1e-9:
            continue
        pencil = np.concatenate([a - eigenvalue * np.eye(len(a)), b], 1)
        left, sizes, _ = np.linalg.svd(pencil)
        if sizes[-1] < 1e-9 * sizes[0]:
            name = point.names[int(np.abs(left[:, -1]).argmax())]
            return f"{name} (modulus {abs(eigenvalue):.4g} a step)"
    return ""


def _positive(curvature: Tensor) -> Matrix:
    """The nearest symmetric matrix without negative eigenvalues; zero where it is not finite."""
    matrix = curvature.detach().double().numpy()
    if not np.isfinite(matrix).all():
        return np.zeros_like(matrix)
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * values.clip(0.0)) @ vectors.T


def is_smooth(task: Task) -> bool:
    """Whether a small command has an effect in proportion, in a task's actuator."""
    numbers = {} if task.actuator is None else task.actuator.config
    return not {"dead_zone", "slew"} & set(numbers)


def _checked(name: str, given: Sequence[float], count: int, *, zero: bool) -> list[float]:
    values = [float(value) for value in given]
    good = all(value >= 0 if zero else value > 0 for value in values)
    if len(values) != count or not good:
        sign = "at least 0" if zero else "above 0"
        raise ConfigError(name, f"expected {count} numbers {sign}, got {tuple(given)}.")
    return values
