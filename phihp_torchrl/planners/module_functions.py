"""Actors and critics that are TensorDict modules, as functions of tensors for a plan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor


def tensor_function(
    module: TensorDictModuleBase, out_key: NestedKey, *, prepared: bool = False
) -> Callable[..., Tensor]:
    """Make a function of the tensors of ``module.in_keys`` that returns ``out_key``.

    A plain :class:`~tensordict.nn.TensorDictModule` and sequences of them are called without a
    tensordict, because making one takes much longer than a small network. Other modules are called
    with a tensordict.

    Args:
        module: a module with one or several ``in_keys``.
        out_key: one of its ``out_keys``.
        prepared: whether to call what a network's method ``prepared`` returns in its place, which
            is faster without a graph.

    Returns:
        ``(*inputs [rows, ...]) -> output``.
    """
    stages = _stages(module)
    in_keys = list(module.in_keys)
    if prepared and len(stages) == 1 and _is_plain(module) and hasattr(module.module, "prepared"):
        return module.module if _has_hooks(module.module) else module.module.prepared()

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


def actor_function(
    module: TensorDictModuleBase, action_key: NestedKey, action_dim: int, *, prepared: bool = False
) -> Callable[[Any], Tensor]:
    """Make a function from observation (tensor or tensordict) to action ``[rows, m]``."""
    function = tensor_function(module, action_key, prepared=prepared)
    keys = list(module.in_keys)

    def act(observation: Any) -> Tensor:
        action = function(*(_read(observation, key) for key in keys))
        return action.reshape(-1, action_dim)

    return act


def value_function(
    module: TensorDictModuleBase,
    value_key: NestedKey,
    action_key: NestedKey,
    action_shape: torch.Size,
    *,
    prepared: bool = False,
) -> Callable[[Any, Tensor], Tensor]:
    """Make a function from observation and action ``[rows, m]`` to min(Q1, Q2) ``[rows]``."""
    function = tensor_function(module, value_key, prepared=prepared)
    keys = list(module.in_keys)

    def value(observation: Any, action: Tensor) -> Tensor:
        action = action.reshape(-1, *action_shape)
        inputs = (action if key == action_key else _read(observation, key) for key in keys)
        return smallest(function(*inputs))

    return value


def smallest(values: Tensor) -> Tensor:
    """Reduce values ``[rows, critics]`` or ``[critics, rows, 1]`` to the smallest, ``[rows]``."""
    return values.amin(-1) if values.ndim == 2 else values.squeeze(-1).amin(0)


def _read(observation: Any, key: NestedKey) -> Tensor:
    return observation if isinstance(observation, Tensor) else observation.get(key)
