"""Episodes of any environment that end where a hard constraint of the task is violated."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs import Transform

from phihp_torchrl.tasks import Task


class ConstraintEnd(Transform):
    """Terminate an episode at the step that violates a hard constraint of the task.

    The environment need not know of the constraint; its observations are complete, with all that
    the task adds to the state.

    Args:
        task: the task, with a hard constraint.

    Examples:
        >>> import torch
        >>> from dataclasses import replace
        >>> from torchrl.envs import TransformedEnv
        >>> from phihp_torchrl import Constraint, get_task
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> task = get_task("cartpole-swingup")
        >>> near = replace(task, constraints=(Constraint("x", high=0.2, hard=True),))
        >>> env = TransformedEnv(SimulatedWorld(task).make_env(), ConstraintEnd(near))
        >>> right = lambda td: td.set("action", torch.tensor([10.0]))
        >>> last = env.rollout(100, right)["next"][-1]
        >>> last["terminated"].item(), last["done"].item(), last["observation"][0].item() > 0.2
        (True, True, True)
    """

    def __init__(self, task: Task) -> None:
        super().__init__()
        self.task = task

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        task = self.task
        before, after = (task.locate(td["observation"]) for td in (tensordict, next_tensordict))
        registers = task.split(before)[1]
        command = task.command(registers, tensordict["action"].to(before.dtype))
        ended = task.limits.ended(task.split(after)[0], command)
        if ended is not None:
            for key in ("terminated", "done"):
                given = next_tensordict[key]
                next_tensordict.set(key, given | ended.reshape(given.shape))
        return next_tensordict
