"""Guards: limits of a state whose crossing ends an episode of a real world."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite
from torchrl.envs import EnvBase, Transform, TransformedEnv

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task
from phihp_torchrl.worlds.base import World

Guards = Mapping[str, float | tuple[float, float]]
"""By name of a state: the largest ``|value|``, or the lowest and the highest value."""


class GuardTransform(Transform):
    """Ends the episode of an environment at the step whose next state crosses a guard.

    The step that crosses it has been taken and is kept. It is a truncation and no termination,
    because the task has not ended there; only the plant must not go on.

    Args:
        task: the task, which names the states.
        guards: the guards.
        crossings: counts of crossings, such as ``{"x above 2": 3}``, which this adds to.

    Raises:
        ConfigError: for a name that is not a state, and for limits that are not in order.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> task, crossings = get_task("cartpole-swingup"), Counter()
        >>> guard = GuardTransform(task, {"x": 0.2}, crossings)
        >>> env = TransformedEnv(SimulatedWorld(task).make_env(), guard, auto_unwrap=False)
        >>> right = lambda td: td.set("action", torch.tensor([10.0]))
        >>> last = env.rollout(100, right)["next"][-1]
        >>> last["truncated"].item(), last["terminated"].item(), dict(crossings)
        (True, False, {'x above 0.2': 1})
    """

    def __init__(self, task: Task, guards: Guards, crossings: Counter[str]) -> None:
        super().__init__()
        self.task = task
        self.limits = read_guards(task, guards)
        self.crossings = crossings

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        done = output_spec["full_done_spec"]
        if "truncated" not in done.keys():  # noqa: SIM118 (a spec, no dictionary)
            done["truncated"] = Binary(shape=done["done"].shape, dtype=torch.bool)
        return super().transform_output_spec(output_spec)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if "truncated" not in tensordict_reset:
            done = tensordict_reset.get("done", torch.zeros(1, dtype=torch.bool))
            tensordict_reset.set("truncated", torch.zeros_like(done))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        crossed = self._crossed(next_tensordict["observation"])
        self.crossings.update(crossed)
        done = next_tensordict["done"]
        ended = torch.full_like(done, bool(crossed))
        truncated = next_tensordict.get("truncated", torch.zeros_like(done))
        next_tensordict.set("truncated", truncated | ended)
        return next_tensordict.set("done", done | ended)

    def _crossed(self, observation: Tensor) -> list[str]:
        state = self.task.system.locate(observation).tolist()
        names, found = self.task.system.state_names, []
        for name, (low, high) in self.limits.items():
            value = state[names.index(name)]
            if value < low:
                found.append(f"{name} below {low:g}")
            elif value > high:
                found.append(f"{name} above {high:g}")
            elif math.isnan(value):
                found.append(f"{name} not a number")
        return found


def read_guards(task: Task, guards: Guards) -> dict[str, tuple[float, float]]:
    """Lowest and highest value of each guarded state, by name.

    Raises:
        ConfigError: for a name that is not a state, for limits that are not in order, and where
            episodes start beyond them.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> read_guards(get_task("cartpole"), {"x": 2.0})
        {'x': (-2.0, 2.0)}
    """
    names, limits = task.system.state_names, {}
    for name, given in guards.items():
        if name not in names:
            raise ConfigError(f"guards.{name}", f"expected one of the states {list(names)}.")
        low, high = given if isinstance(given, (tuple, list)) else (-given, given)
        if not low < high:
            raise ConfigError(
                f"guards.{name}", f"expected a positive number, or low < high, got {given!r}."
            )
        index = names.index(name)
        first, last = task.reset.low[index], task.reset.high[index]
        if first < low or last > high:
            raise ConfigError(
                f"guards.{name}",
                f"expected limits around the task's reset box, {first:g} to {last:g}, since "
                f"episodes start there, got {low:g} to {high:g}.",
            )
        limits[name] = (float(low), float(high))
    return limits


def crossings_text(crossings: Counter[str]) -> str:
    """Counts of crossings as words.

    Examples:
        >>> crossings_text(Counter({"x above 2": 3, "x below -2": 1}))
        'x above 2: 3, x below -2: 1'
    """
    return ", ".join(f"{what}: {count}" for what, count in crossings.most_common())


def guard_env(env: EnvBase, task: Task, guards: Guards, crossings: Counter[str]) -> EnvBase:
    """Add a :class:`GuardTransform` to an environment; without guards it stays as it is."""
    if not guards:
        return env
    # Not unwrapped: the environment may be the user's own, which others use too.
    return TransformedEnv(env, GuardTransform(task, guards, crossings), auto_unwrap=False)


class GuardedWorld(World):
    """A world whose episodes end where they cross a guard.

    Args:
        world: the world.
        guards: the guards.

    Raises:
        ConfigError: as :func:`read_guards`.

    Examples:
        >>> from phihp_torchrl import make_world
        >>> world = GuardedWorld(make_world("cartpole-swingup"), {"x": 0.5})
        >>> rollout = world.make_env().rollout(2)
        >>> world.crossings.total()
        0
    """

    kind = "guarded"
    # Where episodes are played at once, those begun meanwhile would add crossings of their own.
    copies = False

    def __init__(self, world: World, guards: Guards) -> None:
        super().__init__(world.task)
        read_guards(world.task, guards)
        self.world, self.guards = world, guards
        self.crossings: Counter[str] = Counter()

    def make_env(self, *, render: bool = False) -> EnvBase:
        env = self.world.make_env(render=render)
        return guard_env(env, self.task, self.guards, self.crossings)

    def picture(self, env: EnvBase) -> NDArray[Any] | None:
        return self.world.picture(env.base_env if self.guards else env)

    def __str__(self) -> str:
        return str(self.world)
