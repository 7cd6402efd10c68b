"""Actors and critics that are TensorDict modules, as functions of tensors for a plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from phihp_torchrl.config import ConfigError


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
    module: TensorDictModuleBase,
    action_key: NestedKey,
    action_shape: torch.Size,
    *,
    prepared: bool = False,
) -> Callable[[Any], Tensor]:
    """Make a function from observation (tensor or tensordict) to action ``[rows, m]``.

    Raises:
        ConfigError: when called, if the actor does not write one action for each row.
    """
    function = tensor_function(module, action_key, prepared=prepared)
    keys = list(module.in_keys)

    def act(observation: Any) -> Tensor:
        inputs = [_read(observation, key) for key in keys]
        action, rows = function(*inputs), _rows(inputs)
        if action.shape[:1] != (rows,) or action.numel() != rows * action_shape.numel():
            raise ConfigError(
                "actor",
                f"expected {action_key!r} of shape {[rows, *action_shape]} for {rows} rows, "
                f"got {list(action.shape)}.",
            )
        return action.reshape(rows, action_shape.numel())

    return act


def value_function(
    module: TensorDictModuleBase,
    value_key: NestedKey,
    action_key: NestedKey,
    action_shape: torch.Size,
    *,
    prepared: bool = False,
) -> Callable[[Any, Tensor], Tensor]:
    """Make a function from observation and action ``[rows, m]`` to min(Q1, Q2) ``[rows]``.

    Raises:
        ConfigError: when called, if the critic does not write values of a shape that
            :func:`smallest` reads.
    """
    function = tensor_function(module, value_key, prepared=prepared)
    keys = list(module.in_keys)

    def value(observation: Any, action: Tensor) -> Tensor:
        action = action.reshape(action.shape[0], *action_shape)
        inputs = [action if key == action_key else _read(observation, key) for key in keys]
        return smallest(function(*inputs), _rows(inputs), value_key)

    return value


def smallest(values: Tensor, rows: int, key: NestedKey = "state_action_value") -> Tensor:
    """Reduce values ``[rows, critics]`` or ``[critics, rows, 1]`` to the smallest, ``[rows]``.

    Raises:
        ConfigError: for values of another shape, which would become the same for all rows.
    """
    if values.ndim == 2 and values.shape[0] == rows:
        return values.amin(-1)
    if values.ndim == 3 and values.shape[1:] == (rows, 1):
        return values.squeeze(-1).amin(0)
    raise ConfigError(
        "qvalue",
        f"expected {key!r} of shape [{rows}, critics] or [critics, {rows}, 1] for {rows} rows, "
        f"got {list(values.shape)}.",
    )


def _rows(inputs: Sequence[Tensor]) -> int:
    return inputs[0].shape[0]


def _read(observation: Any, key: NestedKey) -> Tensor:
    return observation if isinstance(observation, Tensor) else observation.get(key)
