"""The interface of baselines: from an observation to an action, as an agent's actor."""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from phihp_torchrl.tasks import Task


class Controller(TensorDictModuleBase):
    """A controller by hand, which reads ``"observation"`` and writes ``"action"``.

    A subclass implements :meth:`act` on states. Of a task with an actuator it reads the task's
    observation, registers included; where a world shows the system's alone, ``Agent(task,
    actor=controller)`` remembers what is under way.

    Args:
        task: the task.

    Raises:
        ValueError: when called, for an observation that is missing or of the wrong size.
    """

    def __init__(self, task: Task) -> None:
        super().__init__()
        self.in_keys = ["observation"]
        self.out_keys = ["action"]
        self.task = task

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``[*batch, m]``, in physical units and in its bounds.

        Args:
            tensordict: ``"observation"`` ``[*batch, o]``, and for a controller with a memory
                ``"is_init"``, which is true where an episode starts.
        """
        observation = tensordict.get("observation", None)
        size = self.task.observation_dim
        if observation is None or observation.shape[-1:] != (size,):
            got = "none" if observation is None else f"one of shape {list(observation.shape)}"
            raise ValueError(f"observation: expected {size} components at the end, got {got}.")
        starts = tensordict.get("is_init", None)
        if starts is not None:
            starts = starts.reshape(observation.shape[:-1])
        action = self.act(self.task.locate(observation), starts)
        return tensordict.set("action", self.task.clip_action(action))

    @abstractmethod
    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        """The action ``[*batch, m]`` in a state of the task ``[*batch, n]``; it is then clipped.

        Args:
            state: states, registers included.
            starts: whether an episode starts, bool ``[*batch]``; ``None`` if unknown.
        """

    def reset(self) -> None:
        """Forget the episode; a controller without a memory has nothing to forget."""
