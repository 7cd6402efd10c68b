"""The memory of an acting agent: commands under way, references, and a disturbance's estimate."""

from __future__ import annotations

import logging

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor, nn

from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import DisturbancePart, Task

_log = logging.getLogger(__name__)

COMPLETE = "is_complete"
"""The key that says that somebody has completed an observation already."""


class UnderWay:
    """Completes observations of the system by what a task adds to its state.

    What the agent commanded before is under way. A reference and inputs are read from the keys
    ``"reference"`` and ``"inputs"``: the present value ``[*batch, k]``, or with the preview
    ``[*batch, rows, k]``. Where a key is missing the last values are kept, and move up by a step.
    The disturbance of a task that has one is estimated, whatever the observation says of it.

    Args:
        task: the task, with registers.
        dynamics: the model, which the estimate of a disturbance needs; without one it stays at 0.

    Examples:
        >>> from dataclasses import replace
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.tasks import Actuator
        >>> memory = UnderWay(replace(get_task("pendulum"), actuator=Actuator(delay_steps=1.0)))
        >>> shown = TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]))
        >>> _ = memory.extend(shown)
        >>> memory.record(torch.tensor([2.5]))
        tensor([2.])
        >>> memory.extend(shown)["observation"]
        tensor([1., 0., 0., 1.])
    """

    def __init__(self, task: Task, dynamics: nn.Module | None = None) -> None:
        self.task = task
        self._model = None
        if task.disturbance is not None and dynamics is not None:
            self._model = TaskWorldModel(task, dynamics)
        self._state: Tensor | None = None
        """The state ``[*batch, n]`` that the model expects next, or at first sees."""
        self._doubted: set[str] = set()
        self.has_begun = False
        """Whether an observation was completed since the last :meth:`reset`."""

    def reset(self) -> None:
        """Forget what is under way, the reference and the estimate."""
        self._state, self.has_begun = None, False

    @property
    def estimate(self) -> Tensor | None:
        """The estimated disturbance ``[*batch, size]``; ``None`` before the first step."""
        if self._state is None or self._model is None:
            return None
        return self._disturbance(self.task.split(self._state)[1])[1]

    def is_asked(self, tensordict: TensorDictBase) -> bool:
        """Whether an observation lacks something, or has a disturbance that is to be estimated."""
        if COMPLETE in tensordict.keys():  # noqa: SIM118 (a TensorDict is no mapping)
            return False
        observation = tensordict.get("observation", None)
        sizes = {self.task.system.observation_dim, self.task.shown_dim} - {
            self.task.observation_dim
        }
        if self._model is not None:
            sizes.add(self.task.observation_dim)
        return observation is not None and observation.ndim > 0 and observation.shape[-1] in sizes

    def extend(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict with the observation of the task in place of the one in it.

        Raises:
            ValueError: for a reference or inputs that are missing at the start of an episode, of
                another shape, or not finite; the message names the key.
        """
        task, shown = self.task, tensordict["observation"]
        seen = shown[..., : task.system.observation_dim]
        rest = task.rest(seen)
        starts = torch.zeros([*rest.shape[:-1], 1], dtype=torch.bool, device=rest.device)
        if (given := tensordict.get("is_init", None)) is not None:
            starts = expand_as_right(given.reshape(*tensordict.batch_size, 1), starts)
        expected = self._state
        if expected is None or expected.shape[:-1] != rest.shape[:-1] or _moved(expected, rest):
            expected, starts = None, torch.ones_like(starts)
            registers = rest
        else:
            registers = torch.where(starts, rest, task.split(expected)[1])
        known = shown.shape[-1] - task.system.observation_dim
        if known:  # the first registers, or all of them
            given = task.split(task.locate(task.complete(shown, registers)))[1]
            registers = self._with_estimate(given, registers)
        elif task.outside:
            first = starts if self.has_begun else torch.ones_like(starts)
            registers = self._read(tensordict, registers, first)
        physical = task.system.locate(seen)
        if self._model is not None and expected is not None:
            error = task.system.difference(physical, task.split(expected)[0])
            part, estimate = self._disturbance(registers)
            corrected = part.corrected(estimate, error, task.time_step)
            # A prediction of a state that was not finite says nothing.
            use = ~starts & corrected.isfinite().all(-1, keepdim=True)
            registers = self._put(registers, torch.where(use, corrected, estimate))
        self._state, self.has_begun = torch.cat([physical, registers], -1), True
        return tensordict.copy().set("observation", task.complete(seen, registers))

    def record(self, action: Tensor) -> Tensor:
        """Remember the action ``[*batch, m]`` of a step, of which :meth:`extend` has the state.

        Where an episode starts without an observation, nothing is known of the state but that.

        Returns:
            The command, which is the action within its bounds and its rate.
        """
        if self._state is None:
            size = [*action.shape[:-1], self.task.system.state_dim]
            self._state = self.task.at_rest(action.new_full(size, torch.nan))
        physical, registers = self.task.split(self._state)
        command = self.task.command(registers, action)
        if self._model is not None:
            self._state = self._model.transition(self._state, command).next_state
        else:
            self._state = torch.cat([physical, self.task.acting(registers, command)[1]], -1)
        return command

    def _read(self, tensordict: TensorDictBase, registers: Tensor, starts: Tensor) -> Tensor:
        outside = self.task.outside
        given = {key: tensordict.get(key, None) for key in outside.signals}
        if missing := [key for key, value in given.items() if value is None and starts.any()]:
            signal = outside.signals[missing[0]]
            raise ValueError(
                f"{missing[0]}: expected {signal.names} of shape "
                f"{[*registers.shape[:-1], signal.size]} where an episode starts, got none; later "
                "steps may leave it out, and its last value is then kept."
            )
        own = outside.read(given, registers[..., : outside.size])
        if registers.device.type == "cpu":
            self._doubt(own)
        return outside.replaced(registers, own)

    def _doubt(self, own: Tensor) -> None:
        """Warn, once for each signal, of values beyond those that training has drawn."""
        for key, signal in self.task.outside.signals.items():
            value = signal.value(self.task.outside.split(own)[key])
            low, high = value.new_tensor(signal.low), value.new_tensor(signal.high)
            slack = 1e-4 * (high - low)
            beyond = ((value < low - slack) | (value > high + slack)).any()
            if key not in self._doubted and beyond:
                self._doubted.add(key)
                _log.warning(
                    "%s has values beyond %s to %s, for which the agent was not trained; widen "
                    "low and high of the task's signal and train again.",
                    key,
                    signal.low,
                    signal.high,
                )

    # The estimate among the registers.

    def _disturbance(self, registers: Tensor) -> tuple[DisturbancePart, Tensor]:
        for part, value in self.task.registers.split(registers):
            if isinstance(part, DisturbancePart):
                return part, value
        raise AssertionError("a task with a model for its disturbance has that part")

    def _put(self, registers: Tensor, estimate: Tensor) -> Tensor:
        columns = [
            estimate if isinstance(part, DisturbancePart) else value
            for part, value in self.task.registers.split(registers)
        ]
        return torch.cat(columns, -1)

    def _with_estimate(self, registers: Tensor, ours: Tensor) -> Tensor:
        """Registers of an observation, with our own estimate of a disturbance."""
        if self._model is None:
            return registers
        return self._put(registers, self._disturbance(ours)[1])


def _moved(state: Tensor, like: Tensor) -> bool:
    return state.device != like.device
