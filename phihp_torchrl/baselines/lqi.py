"""The linear-quadratic regulator with integral action, which follows a task's reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.equilibria import Equilibria, find_equilibria
from phihp_torchrl.baselines.point import LinearModel, Matrix, is_smooth, linearise
from phihp_torchrl.baselines.reference import followed, middle, present
from phihp_torchrl.baselines.riccati import Regulator, solve_regulator
from phihp_torchrl.baselines.weights import find_weights
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task

_LONG = 5000
"""Steps in which the answer of a loop to a step of its reference has to end."""


class LQI(Controller):
    r"""The linear-quadratic regulator that follows a task's reference, with integral action.

    .. math:: u = u_r - K (s - s_r) - K_q q, \qquad q_{t+1} = q_t + \Delta t \, (y - r)

    For the reference r of components y of the state, the model rests in :math:`s_r` with the action
    :math:`u_r`. Both are interpolated from a table that is made once, by Newton's method at values
    along the range of each component, so that gravity is reckoned with where it is; to act costs no
    step of the model. A reference beyond the last value at which the model rests counts as that
    one. The gains are those of the model that is linearised in the middle of the range, with the
    integral as a further part of the state (Young and Willems, 1972,
    https://doi.org/10.1080/00207177208932211), so that no steady error is left by a constant load
    or a model that is slightly wrong.

    The integral stands still while the action is on a bound, or on the bound of its rate, and the
    error would drive it further. The cheapest integral, by the cost-to-go P, is
    :math:`-P_{qq}^{-1} P_{qs} (s - s_r)`: an episode starts with that one, and where the reference
    moves, the integral moves by as much as the cheapest does. Else each step of the reference would
    wind it up, and it would overshoot.

    It has the weights of the :class:`LQR`, by the reward's curvature on the reference; where the
    reward has none, what is to be followed weighs as much as the heaviest. The integral is weighed
    so that it acts in the time in which the loop without it answers to a step. An actuator is
    reckoned with as by the LQR. It does not look ahead into a preview.

    Args:
        point: the linear model in the middle of the reference.
        equilibria: where the model rests along the reference.
        regulator: gain and cost of the state and, behind it, the integrals.
        times: the time in which the integral of each component acts, in seconds, ``[k]``.

    Examples:
        >>> from dataclasses import replace
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, Signal, get_task
        >>> def follow(state, action, next_state, reference):
        ...     return -(next_state[..., 0] - reference[..., 0]).square()
        >>> angle = Signal(("theta",), low=(-0.3,), high=(0.3,))
        >>> task = replace(get_task("pendulum"), reference=angle, reward=follow)
        >>> lqi = LQI.from_model(task, HybridDynamics.pure_prior(task))
        >>> upright = task.at_rest(torch.zeros(2, 2))
        >>> state = task.with_signals(upright, torch.tensor([[0.2], [-0.2]]))
        >>> action = lqi(TensorDict(observation=task.observe(state), batch_size=[2]))["action"]
        >>> action.shape, bool(action[0] > 0 > action[1])
        (torch.Size([2, 1]), True)
    """

    gain: Tensor
    integral_gain: Tensor
    cheapest: Tensor

    def __init__(
        self,
        point: LinearModel,
        equilibria: Equilibria,
        regulator: Regulator,
        times: Sequence[float],
    ) -> None:
        super().__init__(point.task)
        self.point, self.equilibria, self.times = point, equilibria, tuple(times)
        self.regulator = regulator
        n = len(point.a)
        gain, cost = (torch.as_tensor(matrix) for matrix in regulator)
        self.register_buffer("gain", gain[:, :n])
        self.register_buffer("integral_gain", gain[:, n:])
        self.register_buffer("cheapest", -torch.linalg.solve(cost[n:, n:], cost[n:, :n]))
        self._places = list(followed(point.task).values())
        self._kept: tuple[Tensor, Tensor] | None = None

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
        state_weights: Sequence[float] | None = None,
        action_weights: Sequence[float] | None = None,
        integral_time: float | None = None,
    ) -> LQI:
        """Build it for a task with a reference, in a model.

        Args:
            task: the task.
            dynamics: the model, ``(state, action) -> next state``.
            state_weights: diagonal of Q for the physical components, in place of the reward's.
            action_weights: diagonal of R, in place of the reward's.
            integral_time: seconds T in which the integrals act: ``q`` weighs as an error of
                ``q / T``. Chosen by default.

        Raises:
            ConfigError: where the reference is of no components of the state or the model does not
                rest at it, for weights or a time of the wrong number or sign, and where the actions
                cannot stabilise the model or are fewer than what is to be followed; the message
                names the component.
        """
        places = _followable(task)
        point = linearise(
            task, dynamics, middle(task), registers=is_smooth(task), follows=list(places)
        )
        equilibria = find_equilibria(point, dynamics)
        q, r, _ = find_weights(task, point, state_weights, action_weights)
        own, extra = list(places.values()), len(point.a) - len(q)
        if not (q.diagonal()[own] > 0).all():
            raise ConfigError("state_weights", f"expected them above 0 for {list(places)}.")
        q = np.pad(q, (0, extra))
        if integral_time is None:
            inner = solve_regulator(task, point.a, point.b, q, r, point.names)
            times = _times(point, own, inner.gain)
        elif integral_time > 0:
            times = np.full(len(own), float(integral_time))
        else:
            raise ConfigError("integral_time", f"expected a number above 0, got {integral_time}.")
        whole = np.diag(np.concatenate([np.zeros(len(q)), q.diagonal()[own] / times**2]))
        whole[: len(q), : len(q)] = q
        a, b = _with_integrals(point, own)
        names = (*point.names, *(f"the integral of {name}" for name in places))
        return cls(point, equilibria, solve_regulator(task, a, b, whole, r, names), times.tolist())

    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        registers = self.task.split(state)[1]
        at, keeping = self.equilibria.at(present(self.task, registers))
        error = self.point.difference(state, at)
        integral = self._recall(error, at, starts)
        back = self.integral_gain.to(state)
        action = keeping - error @ self.gain.to(state).mT - integral @ back.mT
        rates = self.task.time_step * error[..., self._places]
        over = action - self.task.command(registers, action)
        # What each integral would add to each action, [*batch, m, k].
        added = -back * rates.unsqueeze(-2)
        held = (over.unsqueeze(-1) * added > 0).any(-2)
        self._kept = torch.where(held, integral, integral + rates), at
        return action

    def go_on_from(self, state: Tensor, action: Tensor, rows: Tensor) -> None:
        """Set the integrals so that the action would be this one: it takes over without a jump.

        Args:
            state: states of the task, ``[*batch, n]``.
            action: what was sent last, ``[*batch, m]``.
            rows: where to do so, bool ``[*batch]``; elsewhere the integrals stay.
        """
        at, keeping = self.equilibria.at(present(self.task, self.task.split(state)[1]))
        error = self.point.difference(state, at)
        missing = keeping - error @ self.gain.to(state).mT - action
        integral = missing @ torch.linalg.pinv(self.integral_gain.to(state)).mT
        kept = self._recall(error, at, None)
        self._kept = torch.where(rows.unsqueeze(-1), integral, kept), at

    def reset(self) -> None:
        """Start the integrals anew."""
        self._kept = None

    def _recall(self, error: Tensor, at: Tensor, starts: Tensor | None) -> Tensor:
        """The integrals ``[*batch, k]``, moved with the reference."""
        cheapest = self.cheapest.to(error).mT
        first = error @ cheapest
        if self._kept is None or self._kept[1].shape != at.shape:
            return first
        integral, before = (part.to(error) for part in self._kept)
        integral = integral - self.point.difference(at, before) @ cheapest
        return integral if starts is None else torch.where(starts.unsqueeze(-1), first, integral)


def _followable(task: Task) -> dict[str, int]:
    """The components that the reference is of, and their places, if the system can rest there."""
    if not (places := followed(task)):
        raise ConfigError(
            "reference", f"expected one of components of {task.system.state_names}, got none."
        )
    for position, velocity in task.system.velocity_of.items():
        if velocity in places:
            raise ConfigError(
                "reference",
                f"expected one at which the system can rest, but {velocity!r} is the velocity of "
                f"{position!r}, which belongs to its state.",
            )
    return places


def _with_integrals(point: LinearModel, own: Sequence[int]) -> tuple[Matrix, Matrix]:
    """A and B of the state and, behind it, the integrals of its components ``own``."""
    n, k = len(point.a), len(own)
    a, b = np.eye(n + k), np.zeros((n + k, point.b.shape[1]))
    a[:n, :n], b[:n] = point.a, point.b
    a[n + np.arange(k), own] = point.task.time_step
    return a, b


def _times(point: LinearModel, own: Sequence[int], gain: Matrix) -> Matrix:
    """The time in which the loop without integrals answers to a step of each component, ``[k]``.

    It is the area under the size of the error, for a step of 1.
    """
    n, k, seconds = len(point.a), len(own), point.task.time_step
    rows = np.zeros((k, n + point.b.shape[1]))
    rows[np.arange(k), own] = 1.0
    still = np.concatenate([np.concatenate([point.a - np.eye(n), point.b], 1), rows])
    steps = np.linalg.lstsq(still, np.eye(n + k)[:, n:], rcond=None)[0]
    error, closed, area = -steps[:n], point.a - point.b @ gain, np.zeros(k)
    for _ in range(_LONG):
        area += seconds * np.abs(error[own, np.arange(k)])
        error = closed @ error
    return np.maximum(area, seconds)
