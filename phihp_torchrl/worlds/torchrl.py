"""A world of any TorchRL environments: another simulator, a robot, DMControl."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gymnasium
import torch
from numpy.typing import NDArray
from torchrl.data import Bounded
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    EnvBase,
    GymWrapper,
    StepCounter,
    TransformedEnv,
)

from phihp_torchrl.config import ConfigError, check_fields, import_named
from phihp_torchrl.tasks import Task
from phihp_torchrl.worlds.base import World
from phihp_torchrl.worlds.command_memory import command_memory
from phihp_torchrl.worlds.constraint_end import ConstraintEnd
from phihp_torchrl.worlds.open_limits import open_limits
from phihp_torchrl.worlds.signal_source import signal_source


@dataclass(frozen=True)
class TorchRLConfig:
    """Settings of an :class:`EnvWorld` whose environments a function makes.

    Args:
        make: the function, as module:function; modules in the working directory are found too.
        options: keyword arguments of the function.
        copies: whether each call makes a world of its own, as of a simulator, so that several
            episodes can be evaluated at once; false for a rig.

    Raises:
        ConfigError: if ``make`` is not of the form module:function.

    Examples:
        >>> TorchRLConfig("my_robot.make_env")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: make: expected module:function, got 'my_robot.make_env'.
    """

    kind: ClassVar[str] = "torchrl"

    make: str
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    copies: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        module, _, function = self.make.partition(":")
        if not (module and function):
            raise ConfigError("make", f"expected module:function, got {self.make!r}.")


class EnvWorld(World):
    """A world of TorchRL environments: it gives transitions and has no known equations.

    An environment must have the keys of the task: ``"observation"`` ``[o]`` in the order of the
    system's states, with each angle as cosine and sine, ``"action"`` ``[m]`` in physical units, and
    a scalar ``"reward"``. Adapt other environments by transforms
    (:class:`torchrl.envs.TransformedEnv`).

    Args:
        task: the task.
        make: a function that makes an environment of TorchRL or gymnasium, called once for each
            phase that acts in the world; or one TorchRL environment, which all phases use.
        label: name of the world in messages.
        copies: whether each call of the function makes a world of its own, as of a simulator.
            Then evaluation calls it for many episodes, and plays them at once.

    Raises:
        ConfigError: when an environment is made, before any step, if it does not fit the task.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> task = get_task("pendulum")
        >>> world = EnvWorld(task, SimulatedWorld(task).make_env)
        >>> world.make_env().rollout(3)["next", "step_count"].flatten().tolist()
        [1, 2, 3]
        >>> world.truth is None
        True
    """

    kind = "torchrl"

    def __init__(
        self,
        task: Task,
        make: Callable[[], Any] | EnvBase,
        *,
        label: str = "torchrl",
        copies: bool = False,
    ) -> None:
        super().__init__(task)
        single = isinstance(make, EnvBase)
        self._make = (lambda: make) if single else make
        self.label, self.copies = label, copies and not single

    @classmethod
    def from_config(cls, task: Task, config: TorchRLConfig) -> EnvWorld:
        """Make the world whose environments the function ``config.make`` makes."""
        function = import_object("world.make", config.make)
        label = f"torchrl {config.make}"
        return cls(task, lambda: function(**config.options), label=label, copies=config.copies)

    def make_env(self, *, render: bool = False) -> EnvBase:
        env = self._make()
        if isinstance(env, gymnasium.Env):
            env = GymWrapper(env)
        if not isinstance(env, EnvBase):
            raise ConfigError(
                "world.make",
                f"expected a TorchRL or gymnasium environment, got {type(env).__name__}.",
            )
        return fit_env(self.task, env)

    def __str__(self) -> str:
        return self.label


def fit_env(task: Task, env: EnvBase) -> EnvBase:
    """Check that ``env`` fits the task, and add float32 and a count and limit of steps to it.

    Raises:
        ConfigError: if it does not fit; the message names the key, what was expected of it and what
            was found.
    """
    check_keys(task, env)
    transforms = open_limits(env)
    doubles = [
        key
        for key in ("observation", "reward")
        if env.output_spec[_group(key)][key].dtype == torch.float64
    ]
    if doubles:
        transforms.append(DoubleToFloat(in_keys=doubles))
    if "step_count" not in env.observation_spec.keys():  # noqa: SIM118 (a spec, no dictionary)
        transforms.append(StepCounter(max_steps=task.max_steps))
    transforms += signal_source(task, env)
    if env.observation_spec["observation"].shape[-1] != task.observation_dim:
        transforms += command_memory(task)
    if task.limits.ends_episodes:
        transforms.append(ConstraintEnd(task))
    return TransformedEnv(env, Compose(*transforms)) if transforms else env


def check_keys(task: Task, env: EnvBase) -> None:
    """Refuse an environment whose batch size, observation, action or reward are not the task's.

    Raises:
        ConfigError: if it does not fit; the message names the key, what was expected of it and what
            was found.
    """
    if env.batch_size:
        raise ConfigError("world", f"expected batch size [], got {list(env.batch_size)}.")
    _check_observation(task, env)
    _check_action(task, env)
    reward = env.full_reward_spec.get("reward", None)
    if reward is None or reward.shape.numel() != 1:
        found = "none" if reward is None else f"shape {list(reward.shape)}"
        raise ConfigError("world", f"expected a 'reward' of one number, got {found}.")


def import_object(key: str, name: str) -> Any:
    """Import the object that ``module:name`` names; modules in the working directory are found.

    Raises:
        ConfigError: with ``key`` as its key, if there is no such object or its import fails.
    """
    module, _, attribute = name.partition(":")
    try:
        return getattr(import_named(module), attribute)
    # A user's module may raise anything; the message should name it and the reason.
    except Exception as error:
        raise ConfigError(
            key, f"{name} cannot be imported: {type(error).__name__}: {error}"
        ) from error


def _group(key: str) -> str:
    return "full_observation_spec" if key == "observation" else "full_reward_spec"


def _check_observation(task: Task, env: EnvBase) -> None:
    names = [
        part
        for name in task.system.state_names
        for part in ([f"cos {name}", f"sin {name}"] if name in task.system.angles else [name])
    ]
    spec = env.observation_spec.get("observation", None)
    size = task.system.observation_dim
    expected = f"'observation' of shape [{size}] ({', '.join(names)})"
    if spec is None:
        keys = [str(key) for key in env.observation_spec.keys(True, True)]
        raise ConfigError("world", f"expected {expected}, it has {keys}.")
    # An environment that shows signals, or all that is under way, by itself is right too.
    shapes = [(size,), (task.shown_dim,), (task.observation_dim,)]
    if spec.shape not in shapes or not spec.dtype.is_floating_point:
        raise ConfigError(
            "world", f"expected {expected}, got {spec.dtype} of shape {list(spec.shape)}."
        )


def _check_action(task: Task, env: EnvBase) -> None:
    names = task.system.action_names
    spec = env.full_action_spec.get("action", None)
    expected = f"a continuous 'action' of shape [{len(names)}] ({', '.join(names)})"
    if spec is None:
        keys = [str(key) for key in env.action_keys]
        raise ConfigError("world", f"expected {expected}, it has {keys}.")
    if spec.shape != (len(names),) or not spec.dtype.is_floating_point:
        raise ConfigError(
            "world", f"expected {expected}, got {spec.dtype} of shape {list(spec.shape)}."
        )
    if not isinstance(spec, Bounded):
        return
    low, high = spec.space.low.flatten().tolist(), spec.space.high.flatten().tolist()
    ours = zip(task.action_low or (), task.action_high, strict=True)
    for name, a, b, (low_here, high_here) in zip(names, low, high, ours, strict=True):
        slack = 1e-5 * (high_here - low_here)
        if low_here < a - slack or high_here > b + slack:
            raise ConfigError(
                "action_high",
                f"expected bounds of {name} within the world's, {a:g} to {b:g}; the task "
                f"{task.name!r} has {low_here:g} to {high_here:g}.",
            )


def frame(env: Any) -> NDArray[Any] | None:
    """Return the picture that a wrapped gymnasium environment renders, or ``None``.

    Raises:
        ConfigError: if the environment cannot render, as where a library for it is not installed.
    """
    base = getattr(env, "base_env", env)
    inner = getattr(base, "_env", None)
    try:
        picture = inner.render() if inner is not None and hasattr(inner, "render") else None
    except Exception as error:  # somebody else's renderer may raise anything
        raise ConfigError("render", f"{type(error).__name__}: {error}") from error
    return picture if getattr(picture, "ndim", 0) == 3 else None
