"""Velocities from measured positions, one sample at a time, for a rig that measures no speed."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_count, plain
from phihp_torchrl.dynamics import HybridDynamics
from phihp_torchrl.tasks import Task

# The least errors on a pendulum with noise of 0.01 and 0.03 rad, by a model whose constants are
# first guesses, and by none.
_WITH_MODEL, _WITHOUT_MODEL = 0.5, 0.2


class VelocityObserver:
    r"""Completes measured states by the velocities that no sensor measures.

    It predicts the next state, and corrects position x and velocity v by the error e of the
    predicted position:

    .. math:: x \leftarrow x + (1 - p^2)\, e, \qquad v \leftarrow v + (1 - p)^2\, e / \Delta t

    For constant velocities these are the gains with which both errors decay as :math:`p^k`, without
    overshoot (the critically damped g-h filter; Brookner, *Tracking and Kalman Filtering Made
    Easy*, 1998). With a model, the prediction knows the command, so that the velocity does not lag
    behind it, and the task's inputs as they are measured. A position that is missing too (NaN), as
    after a lost packet, is predicted.

    Args:
        task: the task, whose system says which velocity belongs to which position.
        dynamics: the model to predict with; without one, velocities are taken to be constant.
        smoothing: p, in [0, 1): 0 takes differences of the samples, and near 1 noise is averaged
            over about 1 / (1 - p) samples. Defaults to 0.5 with a model and to 0.2 without, where
            each sample more is a lag behind the command.
        most_missing: samples in a row that may lack a position, which is predicted meanwhile.

    Raises:
        ConfigError: for a system without velocities, and for a number out of range.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> observer = VelocityObserver(get_task("pendulum"))
        >>> for k in range(40):  # it turns by 0.01 rad in each step of 0.05 s
        ...     state = observer.update(torch.tensor([0.01 * k, torch.nan]))
        ...     observer.acted(torch.zeros(1))
        >>> round(state[1].item(), 3)
        0.2
    """

    def __init__(
        self,
        task: Task,
        dynamics: HybridDynamics | None = None,
        *,
        smoothing: float | None = None,
        most_missing: int = 5,
    ) -> None:
        if smoothing is None:
            smoothing = _WITHOUT_MODEL if dynamics is None else _WITH_MODEL
        smoothing = plain(smoothing)
        if not (isinstance(smoothing, (int, float)) and 0.0 <= smoothing < 1.0):
            raise ConfigError("smoothing", f"expected a number in [0, 1), got {smoothing!r}.")
        names, pairs = task.system.state_names, dict(task.system.velocity_of)
        if not pairs:
            raise ConfigError("task", "expected a system with velocities, got one without.")
        self.task, self.dynamics = task, dynamics
        self.most_missing = plain(most_missing)
        check_count(self, "most_missing", least=0)
        self._positions = [names.index(name) for name in pairs]
        self._velocities = [names.index(name) for name in pairs.values()]
        self._of_position = 1.0 - smoothing**2
        self._of_velocity = (1.0 - smoothing) ** 2 / task.time_step
        self.reset()

    def reset(self) -> None:
        """Forget everything, at the start of an episode."""
        self._predicted: Tensor | None = None
        self._state: Tensor | None = None
        self._registers: Tensor | None = None
        self._missing = 0

    @torch.no_grad()
    def update(self, measured: Tensor, inputs: Tensor | None = None) -> Tensor:
        """Return the state ``[n]``, physical and complete, for a measured one with NaN in it.

        Where there is too little to go by, some NaN stay.

        Args:
            measured: the state ``[n]`` in physical units, NaN where it is not measured.
            inputs: the task's inputs from now on, ``[k]``, or with their preview ``[rows, k]``, in
                physical units. Without them the last ones are kept, and at first the middle of
                their range is taken. A task that has none does not read them.

        Raises:
            ValueError: for inputs of another shape, or not finite.
        """
        if inputs is not None and self.task.inputs is not None:
            registers, outside = self._under_way(measured), self.task.outside
            own = outside.read({"inputs": inputs}, registers[: outside.size])
            self._registers = outside.replaced(registers, own)
        predicted = self._predicted
        lost = not measured[self._positions].isfinite().all()
        self._missing = self._missing + 1 if lost else 0
        if predicted is None or self._missing > self.most_missing:  # at rest, if nothing is known
            state = measured.clone()
            speeds = state[self._velocities]
            state[self._velocities] = torch.where(speeds.isnan(), torch.zeros_like(speeds), speeds)
        else:
            state = predicted.clone()
            error = self.task.difference(measured, predicted)[self._positions].nan_to_num(0.0)
            state[self._positions] += self._of_position * error
            state[self._velocities] += self._of_velocity * error
            known = measured.isfinite()
            known[self._positions] = False
            state = torch.where(known, measured, state)
        self._state = state
        return state

    @torch.no_grad()
    def acted(self, action: Tensor) -> None:
        """Predict the next state from the action ``[m]`` that has been sent."""
        state = self._state
        if state is None or not state.isfinite().all():
            self._predicted = None
            return
        acting, self._registers = self.task.acting(self._under_way(state), action.to(state))
        if self.dynamics is None:
            self._predicted = state.clone()
            self._predicted[self._positions] += self.task.time_step * state[self._velocities]
        else:
            like = next(self.dynamics.parameters(), state)
            self._predicted = self.dynamics.step(state.to(like), acting.to(like)).to(state)

    def _under_way(self, like: Tensor) -> Tensor:
        """The registers ``[r]`` of the task: inputs, and commands under way."""
        return self.task.rest(like) if self._registers is None else self._registers
