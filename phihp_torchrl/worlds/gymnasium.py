"""A world behind a gymnasium id."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium
from numpy.typing import NDArray
from torchrl.envs import EnvBase, GymWrapper

from phihp_torchrl.config import ConfigError, check_fields
from phihp_torchrl.tasks import Task
from phihp_torchrl.worlds.torchrl import EnvWorld, fit_env, frame

TASK_OF_ID = MappingProxyType({"Pendulum-v1": "pendulum"})
"""The task of the same system with the same observations, by gymnasium id."""


@dataclass(frozen=True)
class GymnasiumConfig:
    """Settings of a :class:`GymnasiumWorld`.

    Args:
        id: gymnasium id, e.g. Pendulum-v1; module:id imports the module that registers it.
        options: keyword arguments of gymnasium.make.
        copies: whether each environment is a world of its own, as of a simulator, so that several
            episodes can be evaluated at once; null for those that come with gymnasium or this
            package, and are not shown in a window.

    Examples:
        >>> from phihp_torchrl import make_world
        >>> str(make_world("pendulum", GymnasiumConfig("Pendulum-v1", options={"g": 9.81})))
        'gymnasium Pendulum-v1'
    """

    kind: ClassVar[str] = "gymnasium"

    id: str
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    copies: bool | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @staticmethod
    def task_of(settings: Mapping[str, Any]) -> str | None:
        """Return the default task for these settings of the world, or ``None``."""
        return TASK_OF_ID.get(str(settings.get("id")))


class GymnasiumWorld(EnvWorld):
    """A world whose environments are made by gymnasium; see :class:`EnvWorld`.

    Args:
        task: the task.
        config: gymnasium id and options.

    Raises:
        ConfigError: when an environment is made, if gymnasium does not know the id or the
            environment does not fit the task.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> world = GymnasiumWorld(get_task("pendulum"), GymnasiumConfig("Pendulum-v1"))
        >>> world.make_env().rollout(2)["observation"].shape
        torch.Size([2, 3])
    """

    kind = GymnasiumConfig.kind

    def __init__(self, task: Task, config: GymnasiumConfig) -> None:
        label = f"gymnasium {config.id}"
        copies = _is_simulator(config) if config.copies is None else config.copies
        super().__init__(task, self._wrap, label=label, copies=copies)
        self.config = config

    def make_env(self, *, render: bool = False) -> EnvBase:
        return fit_env(self.task, self._wrap("rgb_array" if render else None))

    def picture(self, env: EnvBase) -> NDArray[Any] | None:
        return frame(env)

    def _wrap(self, render_mode: str | None = None) -> EnvBase:
        options = dict(self.config.options)
        if render_mode is not None:
            options["render_mode"] = render_mode
        try:
            env = gymnasium.make(self.config.id, **options)
        except (gymnasium.error.Error, TypeError, ImportError) as error:
            raise ConfigError("world.id", f"{self.config.id!r}: {error}") from error
        if not isinstance(env.action_space, gymnasium.spaces.Box):
            raise ConfigError(
                "world.id",
                f"expected continuous actions, {self.config.id!r} has {env.action_space}.",
            )
        return GymWrapper(env)


def _is_simulator(config: GymnasiumConfig) -> bool:
    """Whether the id is known to be a simulator's: others may open a rig, of which there is one."""
    if config.options.get("render_mode") == "human":
        return False
    try:
        entry = gymnasium.spec(config.id).entry_point
    except (gymnasium.error.Error, ImportError):
        return False  # making it will say what is wrong
    module = entry if isinstance(entry, str) else getattr(entry, "__module__", "")
    return module.startswith(("gymnasium.", "phihp_torchrl."))
