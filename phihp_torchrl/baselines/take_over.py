"""The base of regulators that take over from another controller where they are near enough."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task


class TakeOver(nn.Module, ABC):
    """A regulator that acts in states which are near, in the place of whoever acts elsewhere.

    Its numbers are buffers, so it is saved with an agent's weights.

    Args:
        task: the task.
        moved: the registers of the task that belong to the regulator's state, by their places
            (:class:`~phihp_torchrl.baselines.point.LinearModel`).
        shapes: shapes of the buffers, by name.
    """

    kind: ClassVar[str]
    """The name of this sort of regulator in files."""
    distance: ClassVar[str]
    """The buffer that says how near is near enough."""

    def __init__(
        self, task: Task, moved: Sequence[int], shapes: Mapping[str, Sequence[int]]
    ) -> None:
        super().__init__()
        self.task, self.moved = task, tuple(moved)
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(list(shape)))

    @classmethod
    @abstractmethod
    def from_model(cls, task: Task, dynamics: nn.Module, share: float = 1.0) -> Self:
        """Build it in a model, so that it takes over within a share of its distance."""

    @abstractmethod
    def take(self, state: Tensor, starts: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Where it acts, bool ``[*batch]``, and its action ``[*batch, m]``, in a step of a task.

        Args:
            state: states of the task, ``[*batch, n]``.
            starts: whether an episode starts, bool ``[*batch]``; ``None`` if unknown.
        """

    def follow(self, sent: Tensor) -> None:
        """Take note of the action ``[*batch, m]`` that was sent, where it has a memory."""

    def reset(self) -> None:
        """Forget the episode, where it has a memory."""

    def closer(self, share: float) -> Self:
        """The same regulator, which takes over within a share of the distance."""
        made, distance = self.from_config(self.task, self.config), getattr(self, self.distance)
        made.load_state_dict(self.state_dict() | {self.distance: share * distance})
        return made.to(distance.device)

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which it can be built again, without the buffers."""
        return {"kind": self.kind, "moved": list(self.moved)}

    @classmethod
    def from_config(cls, task: Task, config: Mapping[str, Any]) -> Self:
        """Build what :attr:`config` describes, with buffers of zeros.

        Raises:
            ConfigError: for what the task does not have; the message names the key.
        """
        return cls(task, check_moved(task, config["moved"]))  # type: ignore[call-arg]


def check_moved(task: Task, moved: Any) -> tuple[int, ...]:
    """The places of registers that a file names.

    Raises:
        ConfigError: for others than the task has.
    """
    places = range(task.register_count)
    if not isinstance(moved, (list, tuple)) or not set(moved) <= set(places):
        raise ConfigError("moved", f"expected places below {len(places)}, got {moved!r}.")
    return tuple(moved)
