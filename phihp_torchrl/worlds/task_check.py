"""One dry check of a system, a task and a world together, before any real step."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task, check_functions, find_task
from phihp_torchrl.worlds.registry import make_world
from phihp_torchrl.worlds.torchrl import check_keys


def check_task(task: str | Task, world: Any = None) -> None:
    """Check that a system, a task and a world fit each other, without taking a step.

    The functions of the task and of its system are called for a few start states, in batches and
    one by one: shapes, dtypes, finite numbers, and that rows of a batch do not mix. If a world is
    given, an environment of it is made and reset once, and its keys are compared with the task's.
    A run makes the same checks before its first real step; it also compares the rewards and
    terminations of real steps with the task's, and warns where they differ. Compare TorchRL's
    :func:`torchrl.envs.utils.check_env_specs`, which checks an environment against its own specs.

    Args:
        task: a task, or the name of a registered one.
        world: the world, in any form that :func:`~phihp_torchrl.make_world` accepts; ``None`` to
            check the task alone.

    Raises:
        ConfigError: for the first thing that does not fit; the message names the function or the
            key, what was expected of it and what came.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> check_task("cartpole", "simulated")
        >>> pendulum = get_task("pendulum")
        >>> def upright(state, action, next_state):
        ...     return next_state[..., :1].cos()
        >>> check_task(replace(pendulum, reward=upright))
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: reward, upright: expected float32 of shape [6] for \
tensors of shape [6, 2], [6, 1], [6, 2], got float32 of shape [6, 1].
    """
    task = find_task(task)
    check_functions(task)
    if world is not None:
        real = make_world(task, world)
        if real.has_env:
            check_env(task, real.make_env())


def check_env(task: Task, env: Any) -> None:
    """Check the keys of an environment of a world against the task, and reset it once.

    Args:
        task: the task.
        env: what :meth:`World.make_env` returned.

    Raises:
        ConfigError: for the first key that does not fit the task.
    """
    if not isinstance(env, EnvBase):
        raise ConfigError("world", f"expected a TorchRL environment, got {type(env).__name__}.")
    check_keys(task, env)
    found = env.observation_spec["observation"].shape
    if found != (task.observation_dim,):
        raise ConfigError(
            "world",
            f"expected 'observation' of shape [{task.observation_dim}] with all that the task adds "
            f"to the state, got {list(found)}; command_memory(task) adds it.",
        )
    if (ended := env.full_done_spec.get("terminated", None)) is None or ended.dtype != torch.bool:
        got = "none" if ended is None else str(ended.dtype)
        raise ConfigError("world", f"expected a boolean 'terminated', got {got}.")
    try:
        first = env.reset()
    # Somebody else's environment may raise anything; the message should say what was done.
    except Exception as error:
        raise ConfigError(
            "world", f"its environment cannot be reset: {type(error).__name__}: {error}"
        ) from error
    _check_first(task, first)


def _check_first(task: Task, first: TensorDictBase) -> None:
    """Check what a reset returned."""
    observation = first.get("observation", None)
    if observation is None or observation.shape != (task.observation_dim,):
        got = "none" if observation is None else f"shape {list(observation.shape)}"
        raise ConfigError(
            "world", f"expected a reset to return an 'observation' of its spec's shape, got {got}."
        )
    count = first.get("step_count", None)
    if count is None or count.numel() != 1:
        got = "none" if count is None else f"shape {list(count.shape)}"
        raise ConfigError(
            "world",
            f"expected a reset to return a 'step_count' of one number, got {got}; add TorchRL's "
            f"StepCounter(max_steps={task.max_steps}) to the environment.",
        )
