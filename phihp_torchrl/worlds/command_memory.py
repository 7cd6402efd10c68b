"""The observations of a world, with what its task adds to the state, and the rate of commands."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

from phihp_torchrl.tasks import Task


def command_memory(task: Task) -> list[Transform]:
    """The transforms that an environment of ``task`` needs for what is under way; none or one."""
    return [CommandMemory(task)] if task.register_count else []


class CommandMemory(Transform):
    """Append the registers of a task to the observations of an environment, and limit the rate.

    A world shows the system alone. What is under way between a command and its effect, and the last
    action, follow from the commands of the episode, and the observation of the task has them behind
    the system's. The environment gets each command within the rate that the task allows.

    Args:
        task: the task, with registers.

    Examples:
        >>> from dataclasses import replace
        >>> from torchrl.envs import TransformedEnv
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.tasks import Actuator
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> task = get_task("pendulum")
        >>> late = replace(task, actuator=Actuator(delay_steps=1.0))
        >>> env = TransformedEnv(SimulatedWorld(task).make_env(), CommandMemory(late))
        >>> steps = env.rollout(3)
        >>> steps["next", "observation"][:, -1:].equal(steps["action"] / 2.0)
        True
    """

    def __init__(self, task: Task) -> None:
        super().__init__(in_keys=["observation"], out_keys=["observation"])
        self.task = task

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shown = tensordict_reset["observation"]
        if shown.shape[-1] == self.task.observation_dim:  # a row whose episode goes on
            return tensordict_reset
        fresh = self.task.complete(shown, self.task.rest(shown))
        mask = tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            fresh = torch.where(expand_as_right(mask, fresh), fresh, tensordict["observation"])
        return tensordict_reset.set("observation", fresh)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.task.action_rate_limit is None or "action" not in tensordict:
            return tensordict
        registers, action = self._registers(tensordict), tensordict["action"]
        command = self.task.command(registers, action.to(registers.dtype))
        return tensordict.set("action", command.to(action.dtype))

    def _registers(self, tensordict: TensorDictBase) -> Tensor:
        return self.task.split(self.task.locate(tensordict["observation"]))[1]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = self._registers(tensordict)
        _, after = self.task.acting(before, tensordict["action"].to(before.dtype))
        shown = next_tensordict["observation"]
        return next_tensordict.set("observation", self.task.complete(shown, after))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        spec = observation_spec["observation"]
        shape = (*spec.shape[:-1], self.task.observation_dim)
        observation_spec["observation"] = Unbounded(shape, dtype=spec.dtype, device=spec.device)
        return observation_spec
