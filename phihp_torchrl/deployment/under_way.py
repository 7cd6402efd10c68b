"""The memory of an acting agent: the commands under way, and the last one."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor

from phihp_torchrl.tasks import Task


class UnderWay:
    """Completes observations of the system by what the agent commanded before.

    Args:
        task: the task, with registers.

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

    def __init__(self, task: Task) -> None:
        self.task = task
        self._registers: Tensor | None = None

    def reset(self) -> None:
        """Forget what is under way."""
        self._registers = None

    def is_asked(self, tensordict: TensorDictBase) -> bool:
        """Whether the observation is the system's alone."""
        observation = tensordict.get("observation", None)
        return observation is not None and observation.shape[-1:] == (
            self.task.system.observation_dim,
        )

    def extend(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict with the observation of the task in place of the system's."""
        shown = tensordict["observation"]
        rest = self.task.rest(shown)
        kept = self._registers
        if kept is None or kept.shape != rest.shape or kept.device != rest.device:
            kept = rest
        if (starts := tensordict.get("is_init", None)) is not None:
            starts = starts.reshape(*tensordict.batch_size, 1)
            kept = torch.where(expand_as_right(starts, rest), rest, kept)
        self._registers = kept
        return tensordict.copy().set("observation", self.task.complete(shown, kept))

    def record(self, action: Tensor) -> Tensor:
        """Remember the action ``[*batch, m]`` of a step for which :meth:`extend` was asked.

        Returns:
            The command, which is the action within its bounds and its rate.
        """
        assert self._registers is not None
        command = self.task.command(self._registers, action)
        self._registers = self.task.acting(self._registers, command)[1]
        return command
