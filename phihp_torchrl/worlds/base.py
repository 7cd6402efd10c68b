"""The interface of worlds, from which real transitions come."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import NDArray
from torchrl.envs import EnvBase

from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.recordings import Recording
from phihp_torchrl.tasks import Task

if TYPE_CHECKING:
    from phihp_torchrl.worlds.simulated.plant import Plant


class World(ABC):
    """The world in which a task is learned and evaluated: a robot, or a simulation of one.

    Training uses only the transitions of its environments. Only a simulated world has known
    equations (:attr:`truth`, :meth:`model`); for other worlds these are ``None``. A subclass has a
    ``kind`` and implements :meth:`make_env`.

    Args:
        task: the task.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> class Rig(World):
        ...     kind = "rig"
        ...
        ...     def make_env(self, *, render=False):
        ...         return SimulatedWorld(self.task).make_env()
        >>> rig = Rig(get_task("pendulum"))
        >>> rig.make_env().rollout(2)["observation"].shape, rig.truth
        (torch.Size([2, 3]), None)
    """

    kind: ClassVar[str]
    """The name that settings use."""
    has_env: ClassVar[bool] = True
    """Whether one can act in it; a world without an environment has :attr:`recordings`."""

    copies: bool = False
    """Whether every environment of :meth:`make_env` is a world of its own, as simulators are and a
    rig is not. Then evaluation plays several episodes at once."""

    def __init__(self, task: Task) -> None:
        self.task = task

    @abstractmethod
    def make_env(self, *, render: bool = False) -> EnvBase:
        """Make a TorchRL environment of batch size ``[]`` that counts and limits its steps.

        It has ``"observation"`` ``[o]`` and ``"action"`` ``[m]`` in the order of the task's system,
        in float32 and physical units, and ``"step_count"``.

        Args:
            render: whether :meth:`picture` will be called with the environment.
        """

    @property
    def recordings(self) -> list[Recording] | None:
        """What was recorded, of a world in which one cannot act; ``None`` for other worlds."""
        return None

    def picture(self, env: EnvBase) -> NDArray[Any] | None:
        """Draw the current state, ``[height, width, 3]`` uint8; ``None`` if the world cannot.

        Args:
            env: an environment that :meth:`make_env` made with ``render=True``.
        """
        return None

    @property
    def truth(self) -> Plant | None:
        """The plant of a simulated world; ``None`` for other worlds."""
        return None

    def model(self) -> TaskWorldModel | None:
        """Return a simulated world as an exact model of any batch shape; ``None`` for others."""
        return None

    def __str__(self) -> str:
        return self.kind
