"""The registered kinds of worlds, and the function that makes a world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import gymnasium
from torchrl.envs import EnvBase, GymWrapper

from phihp_torchrl.config import ConfigError, Registry, default_of, offer, read_kind
from phihp_torchrl.recordings import RecordedData, Recording
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.worlds.base import World
from phihp_torchrl.worlds.gymnasium import GymnasiumConfig, GymnasiumWorld
from phihp_torchrl.worlds.recorded import RecordedConfig, RecordedWorld
from phihp_torchrl.worlds.simulated import SimulatedConfig, SimulatedWorld
from phihp_torchrl.worlds.torchrl import EnvWorld, TorchRLConfig


@dataclass(frozen=True)
class WorldKind:
    """A registered kind of world.

    Args:
        config: dataclass of its settings.
        build: ``(task, config) -> world``.
        about: description in one line.
    """

    config: type[Any]
    build: Callable[[Task, Any], World]
    about: str = ""


WORLDS: Registry[WorldKind] = Registry("world")
"""Registered kinds of worlds by name; the first is the default."""


def register_world(
    name: str,
    config: type[Any],
    build: Callable[[Task, Any], World],
    *,
    about: str = "",
    replace: bool = False,
) -> WorldKind:
    """Register a kind of world, for ``world=name world.setting=...`` in settings.

    Args:
        name: the name.
        config: dataclass of its settings, with a class attribute ``kind`` that equals ``name``.
        build: ``(task, config) -> world``.
        about: description in one line.
        replace: whether a kind of that name may be replaced.

    Returns:
        The registered kind.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false.

    Examples:
        >>> kind = register_world("simulated", SimulatedConfig, SimulatedWorld, replace=True)
        >>> type(make_world("pendulum", "simulated")).__name__
        'SimulatedWorld'
    """
    kind = WORLDS.register(name, WorldKind(config, build, about), replace=replace)
    # A field without a default must be given, which Hydra's ??? enforces.
    node = {f.name: default_of(f) for f in fields(config) if f.init}
    offer("world", name, {"world": {"kind": name, **node}})
    return kind


def make_world(task: str | Task, world: Any = "simulated") -> World:
    """Make the world that ``world`` describes, for ``task``.

    Args:
        task: a task, or the name of a registered one.
        world: the name of a kind of world, a mapping of its settings with their ``kind``, a
            dataclass of its settings, a TorchRL or gymnasium environment, a function that makes
            one, recordings, or a :class:`World`.

    Raises:
        ConfigError: for a kind that is not registered, settings that it does not have, or a
            :class:`World` of another task.

    Examples:
        >>> str(make_world("pendulum", {"kind": "gymnasium", "id": "Pendulum-v1"}))
        'gymnasium Pendulum-v1'
        >>> import gymnasium, phihp_torchrl
        >>> make_world("acrobot", gymnasium.make("phihp/Acrobot-v0")).kind
        'torchrl'
    """
    task = find_task(task)
    if isinstance(world, World):
        if world.task.name != task.name:
            raise ConfigError(
                "world", f"expected a world of task {task.name!r}, got one of {world.task.name!r}."
            )
        return world
    if isinstance(world, str):
        WORLDS.find(world)
        world = {"kind": world}
    if isinstance(world, Mapping):
        world = read_kind(WORLDS, world, "world")
    if isinstance(world, Recording):
        world = [world]
    if isinstance(world, RecordedData) or _are_recordings(world):
        return RecordedWorld(task, world)
    if isinstance(world, gymnasium.Env):
        world = GymWrapper(world)
    kind = getattr(type(world), "kind", "")
    if kind in WORLDS and isinstance(world, WORLDS[kind].config):
        return WORLDS[kind].build(task, world)
    if isinstance(world, EnvBase) or callable(world):
        return EnvWorld(task, world, label=getattr(world, "__name__", type(world).__name__))
    raise ConfigError(
        "world",
        f"expected one of {sorted(WORLDS)}, settings, an environment, a function that makes one or "
        f"recordings, got {world!r}.",
    )


def has_env(world: Any) -> bool:
    """Whether one can act in the world that settings describe; asked before it is made.

    Args:
        world: the name of a kind of world, or settings as :func:`make_world` takes them.

    Examples:
        >>> has_env("simulated"), has_env({"kind": "recorded", "files": "logs/*.csv"})
        (True, False)
    """
    name = world.get("kind") if isinstance(world, Mapping) else world
    kind = WORLDS.get(name) if isinstance(name, str) else None
    return bool(getattr(world if kind is None else kind.config, "has_env", True))


def _are_recordings(world: Any) -> bool:
    listed = isinstance(world, (list, tuple)) and bool(world)
    return listed and all(isinstance(each, Recording) for each in world)


@dataclass(frozen=True)
class GivenConfig:
    """Settings of a world that was passed from Python, and cannot be made from settings."""

    kind: ClassVar[str] = "given"


def _refuse(task: Task, config: GivenConfig) -> World:
    raise ConfigError(
        "world.kind",
        "this run was started from Python with a world of its own; pass that world again.",
    )


register_world(
    SimulatedConfig.kind,
    SimulatedConfig,
    SimulatedWorld,
    about="the task's own equations with true constants and friction",
)
register_world(
    GymnasiumConfig.kind,
    GymnasiumConfig,
    GymnasiumWorld,
    about="a gymnasium id: world=gymnasium world.id=Pendulum-v1",
)
register_world(
    TorchRLConfig.kind,
    TorchRLConfig,
    EnvWorld.from_config,
    about="any TorchRL environment: world=torchrl world.make=module:function",
)
register_world(
    RecordedConfig.kind,
    RecordedConfig,
    RecordedWorld.from_config,
    about="recordings alone: world=recorded world.files=logs/*.csv",
)
register_world(
    GivenConfig.kind,
    GivenConfig,
    _refuse,
    about="an environment that learn(task, world) was given in Python",
)
