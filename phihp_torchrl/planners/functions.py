"""Actors and critics as functions of tensors, and environments as models."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp


def tensor_function(module: TensorDictModuleBase, out_key: NestedKey) -> Callable[..., Tensor]:
    """What ``module`` computes for ``out_key``, as a function of the tensors of its ``in_keys``.

    Plain :class:`~tensordict.nn.TensorDictModule` and sequences of them are called without a
    tensordict, which takes much longer than a small network. Anything else is given one.

    Args:
        module: a module with one or several ``in_keys``.
        out_key: one of its ``out_keys``.

    Returns:
        ``(*inputs [rows, ...]) -> output``.
    """
    stages = _stages(module)
    in_keys = list(module.in_keys)

    def call(*inputs: Tensor) -> Tensor:
        values = dict(zip(in_keys, inputs, strict=True))
        for stage in stages:
            arguments = [values[key] for key in stage.in_keys]
            if _is_plain(stage):
                values[stage.out_keys[0]] = stage.module(*arguments)
            else:
                tensordict = TensorDict(batch_size=arguments[0].shape[:1])
                for key, value in zip(stage.in_keys, arguments, strict=True):
                    tensordict.set(key, value)
                tensordict = stage(tensordict)
                values.update({key: tensordict.get(key) for key in stage.out_keys})
        return values[out_key]

    return call


def _stages(module: TensorDictModuleBase) -> list[TensorDictModuleBase]:
    if type(module).forward is TensorDictSequential.forward and not _has_hooks(module):
        return [stage for child in module.module for stage in _stages(child)]
    return [module]


def _is_plain(module: TensorDictModuleBase) -> bool:
    return (
        type(module).forward is TensorDictModule.forward
        and len(module.out_keys) == 1
        and module.method is None
        and not module.method_kwargs
        and getattr(module, "_kwargs", None) is None
        and not _has_hooks(module)
    )


def _has_hooks(module: torch.nn.Module) -> bool:
    return bool(module._forward_hooks or module._forward_pre_hooks)


def smallest(values: Tensor) -> Tensor:
    """min(Q1, Q2) ``[rows]`` of values ``[rows, critics]``, or stacked ``[critics, rows, 1]``."""
    return values.amin(-1) if values.ndim == 2 else values.squeeze(-1).amin(0)


class EnvModel:
    """A stateless TorchRL environment in the place of a tensor model: states are tensordicts.

    It steps without ever resetting: sequences that ended go on, and do not count any more.

    Args:
        env: the environment, of batch size ``[]``.
        action_key: its action.
        action_shape: shape of one action.
        reward_key: where a step leaves the reward, with the leading ``"next"``.
        done_keys: where a step leaves that nothing follows, with the leading ``"next"``.
    """

    def __init__(
        self,
        env: EnvBase,
        action_key: NestedKey,
        action_shape: torch.Size,
        reward_key: NestedKey,
        done_keys: Sequence[NestedKey],
    ) -> None:
        self.env = env
        self.action_key = action_key
        self.action_shape = action_shape
        self.reward_key = reward_key
        self.done_keys = tuple(done_keys)

    def locate(self, observation: TensorDictBase) -> TensorDictBase:
        """What the environment needs to step is what was observed."""
        return observation

    def observe(self, state: TensorDictBase) -> TensorDictBase:
        """Actor and critic read their own keys."""
        return state

    def transition(
        self, state: TensorDictBase, action: Tensor
    ) -> tuple[TensorDictBase, Tensor, Tensor]:
        """One step of the environment, ``[rows]``."""
        state = state.copy().set(self.action_key, action.reshape(-1, *self.action_shape))
        state = self.env.step(state)
        reward = state.get(self.reward_key).reshape(-1)
        over = torch.zeros_like(reward, dtype=torch.bool)
        for key in self.done_keys:
            over = over | state.get(key).reshape(-1)
        next_state = step_mdp(
            state,
            reward_keys=self.env.reward_keys,
            done_keys=self.env.done_keys,
            action_keys=self.env.action_keys,
        )
        return next_state, reward, over
