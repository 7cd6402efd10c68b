"""The score of action sequences by an advantage module of TorchRL's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners.env_model import EnvModel


def advantage_judge(
    model: EnvModel, module: nn.Module, key: NestedKey = "advantage"
) -> Callable[[TensorDictBase, Tensor], Tensor]:
    """Make a function that scores sequences ``[H, rows, m]`` by the advantage of their first step.

    Rewards after the first flag that ends a sequence are zero.

    Args:
        model: the environment that is stepped.
        module: writes ``key`` ``[rows, H, 1]`` for a tensordict ``[rows, H]`` of steps, as
            :class:`torchrl.objectives.value.TDLambdaEstimator` does.
        key: the key of the advantage.

    Raises:
        ConfigError: when called, if the module writes no advantage for each step.
    """

    def judge(state: TensorDictBase, actions: Tensor) -> Tensor:
        rows, steps, ended = actions.shape[1], [], None
        for action in actions.unbind(0):
            step, state, reward, over = model.take(state, action)
            if ended is not None:
                reward = torch.where(ended, torch.zeros_like(reward), reward)
            ended = over if ended is None else ended | over
            shape = step.get(model.reward_key).shape
            steps.append(step.set(model.reward_key, reward.reshape(shape)))
        # What a reset writes and a step does not, the first one has alone.
        common = set.intersection(*(set(step.keys(True, True)) for step in steps))
        sequences: Any = torch.stack([step.select(*common) for step in steps], 1)
        sequences = sequences.contiguous()
        module(sequences)
        found = sequences.get(key, None)
        if found is None or found.numel() != rows * len(steps):
            got = "none" if found is None else str(list(found.shape))
            raise ConfigError(
                "advantage_module", f"expected {key!r} of shape {[rows, len(steps), 1]}, got {got}."
            )
        return found.reshape(rows, len(steps))[:, 0]

    return judge
