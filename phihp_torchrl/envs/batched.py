"""The real worlds as batched TorchRL environments: many evaluation episodes at once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv

from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.envs.world_model import WorldModelEnv
from phihp_torchrl.integrators import Integrator
from phihp_torchrl.tasks import Task, get_task


def make_task_env(
    task: str | Task,
    batch_size: Sequence[int] = (),
    *,
    seed: int | None = None,
    integrator: str | Integrator | None = None,
    device: torch.device | str | None = None,
) -> TransformedEnv:
    """The task's world, friction included, as many times as asked for.

    It is the :class:`~phihp_torchrl.WorldModelEnv` of the oracle, so world and imagination share
    all but their dynamics. Episodes are truncated after ``task.max_steps``, and count
    ``"step_count"`` and ``"episode_reward"``.

    Args:
        task: a task or the name of a registered one.
        batch_size: number of worlds, in any shape.
        seed: seed of the resets.
        integrator: how the world integrates. Defaults to the task's integrator.
        device: device of the data. Defaults to the CPU.

    Returns:
        The environment, in float32.

    Examples:
        >>> env = make_task_env("cartpole", [50], seed=0)
        >>> env.rollout(500, break_when_any_done=False)["next", "episode_reward"].shape
        torch.Size([50, 500, 1])
    """
    task = get_task(task) if isinstance(task, str) else task
    model = TaskWorldModel(task, HybridDynamics.oracle(task, integrator=integrator))
    env = WorldModelEnv(model, batch_size=batch_size, device=device, seed=seed)
    return TransformedEnv(env, Compose(StepCounter(max_steps=task.max_steps), RewardSum()))
