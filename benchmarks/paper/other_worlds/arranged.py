"""An environment of dm_control in the words of a task: one observation, actions in their units."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv

Arrange = Callable[..., list[Tensor]]
"""The entries of dm_control's observation -> the columns of a task's, each ``[*batch]``."""


class Arranged(Transform):
    """Put the entries of an observation in the order of a task, and scale the action.

    Args:
        entries: names of the entries that dm_control gives.
        arrange: called with the columns of all entries, ``[*batch]`` each, in their order.
        size: number of columns that it returns.
        unit: physical action at dm_control's full action, 1.
    """

    def __init__(self, entries: tuple[str, ...], arrange: Arrange, size: int, unit: float) -> None:
        super().__init__(
            in_keys=list(entries),
            out_keys=["observation"],
            in_keys_inv=["action"],
            out_keys_inv=["action"],
        )
        self.arrange, self.size, self.unit = arrange, size, unit

    def _call(self, next_tensordict):  # type: ignore[no-untyped-def]
        columns = torch.cat([next_tensordict[key] for key in self.in_keys], -1).unbind(-1)
        seen = torch.stack(self.arrange(*columns), -1).float()
        return next_tensordict.set("observation", seen)

    def _reset(self, tensordict, tensordict_reset):  # type: ignore[no-untyped-def]
        return self._call(tensordict_reset)

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return action / self.unit

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the observation ``[size]``."""
        observation_spec["observation"] = Unbounded((self.size,), dtype=torch.float32)
        return observation_spec

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Bounds in physical units."""
        shape = action_spec["action"].shape
        action_spec["action"] = Bounded(-self.unit, self.unit, shape=shape, dtype=torch.float32)
        return action_spec


def dm_control_env(
    domain: str,
    arrange: Arrange,
    *,
    size: int,
    unit: float = 1.0,
    action_repeat: int = 2,
    task: str = "swingup",
) -> EnvBase:
    """dm_control's ``task`` in ``domain``, without pictures, each action held for some steps."""
    os.environ.setdefault("MUJOCO_GL", "disabled")
    from torchrl.envs import DMControlEnv

    env = DMControlEnv(domain, task, frame_skip=action_repeat)
    entries = tuple(key for key in env.observation_spec if key != "pixels")
    return TransformedEnv(env, Arranged(entries, arrange, size, unit))
