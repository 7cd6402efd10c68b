"""The linear-quadratic regulator of a model at a task's goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.point import LinearModel, Matrix, is_smooth, linearise
from phihp_torchrl.baselines.riccati import solve_regulator
from phihp_torchrl.baselines.weights import find_weights
from phihp_torchrl.tasks import Task


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

    @property
    def dynamics(self) -> nn.Module | None:
        """The model that it was made in, if it is known."""
        return self.point.dynamics

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
            ConfigError: where the task has no goal in which the model rests, or has a reference,
                which an :class:`LQI` follows, for weights of the wrong number or sign, and where
                the action cannot stabilise the goal; the message names the component that it does
                not reach.
        """
        point = linearise(task, dynamics, goal, registers=is_smooth(task))
        weights = find_weights(task, point, state_weights, action_weights)
        n = task.system.state_dim
        whole = np.zeros_like(point.a)
        whole[:n, :n] = weights.q
        found = solve_regulator(task, point.a, point.b, whole, weights.r, point.names)
        return cls(point, *found, weights.unit)

    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        return self.point.action.to(state) - self.point.difference(state) @ self.gain.to(state).mT

    def value(self, state: Tensor) -> Tensor:
        """The cost-to-go of the unbounded regulator, ``[*batch]``, in units of its weights."""
        error = self.point.difference(state)
        return ((error @ self.cost.to(state)) * error).sum(-1)
