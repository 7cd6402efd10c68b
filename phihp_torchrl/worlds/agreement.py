"""Comparison of a world with its task: terminations and rewards of real transitions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from phihp_torchrl.tasks import Task

_REWARD_TOLERANCE = 0.05
"""Mean difference of rewards that is reported, as a share of their standard deviation."""


def disagreements(task: Task, data: TensorDictBase) -> list[str]:
    """List where real transitions contradict the task, as sentences with counts.

    Imagined episodes have the task's terminations and rewards. If those of the world differ, the
    policy is trained for another goal than the one it is judged by.

    Args:
        task: the task.
        data: real transitions ``[N]`` with ``"observation"``, ``"action"`` and, under ``"next"``,
            ``"observation"``, ``"reward"`` and ``"terminated"``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> task = get_task("cartpole")
        >>> observation = task.observe(torch.zeros(4, 4))
        >>> following = TensorDict(
        ...     observation=observation,
        ...     reward=torch.ones(4, 1),
        ...     terminated=torch.tensor([[False], [False], [True], [False]]),
        ...     batch_size=[4],
        ... )
        >>> data = TensorDict(
        ...     observation=observation, action=torch.zeros(4, 1), next=following, batch_size=[4]
        ... )
        >>> disagreements(task, data)[0][:67]
        'the world ended 1 of 4 steps after which the task says it goes on, '
    """
    state = task.locate(data["observation"])
    next_state = task.locate(data["next", "observation"])
    ours = task.is_terminated(next_state)
    theirs = data["next", "terminated"].reshape(-1)
    found = []
    if early := int((theirs & ~ours).sum()):
        found.append(
            f"the world ended {early} of {len(theirs)} steps after which the task says it goes on, "
            "so imagined lives will go on too; say it in Task(terminated=...)"
        )
    if late := int((ours & ~theirs).sum()):
        found.append(
            f"the world went on after {late} of {len(theirs)} steps that the task says are the "
            "last, so imagined lives will be shorter than real ones"
        )
    command = task.command(task.split(state)[1], data["action"])
    expected = task.earned(state, command, next_state)
    given = data["next", "reward"].reshape(-1)
    difference = (given - expected).abs().mean().item()
    spread = torch.cat([given, expected]).std(correction=0).item()
    if difference > _REWARD_TOLERANCE * max(spread, 1e-6) and difference > 1e-3:
        found.append(
            f"the world's reward differs from the task's by {difference:.3g} a step on average "
            f"(their spread is {spread:.3g}), and the policy is learned for the task's"
        )
    return found
