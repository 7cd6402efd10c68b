"""The tensor model of an environment, also behind transforms that change rewards alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tensordict import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    RewardClipping,
    RewardScaling,
    RewardSum,
    SignTransform,
    StepCounter,
    Transform,
    TransformedEnv,
)

from phihp_torchrl.planners.problem import TensorModel

_OF_REWARDS = (RewardScaling, RewardClipping, SignTransform)
_COUNTING = (StepCounter, InitTracker, RewardSum)  # what they add, no plan reads


class _Rewarded:
    """A tensor model with transformed rewards."""

    def __init__(self, model: TensorModel, transforms: Iterable[Transform]) -> None:
        self.model, self.transforms = model, tuple(transforms)
        self.locate, self.observe = model.locate, model.observe
        self.compiles = getattr(model, "compiles", True)

    def transition(self, state: Any, action: Tensor) -> tuple[Any, Tensor, Tensor]:
        state, reward, terminated = self.model.transition(state, action)
        reward = reward.unsqueeze(-1)
        for transform in self.transforms:
            reward = transform._apply_transform(reward)
        return state, reward.squeeze(-1), terminated


def transforms_of(env: EnvBase) -> list[Transform]:
    """Return the transforms around an environment, the innermost first."""
    if not isinstance(env, TransformedEnv):
        return []
    transform = env.transform
    return list(transform) if isinstance(transform, Compose) else [transform]


def why_no_tensor_model(env: EnvBase, reward_key: NestedKey) -> str | None:
    """Return the reason why a plan on ``env`` cannot call a tensor model, or ``None``."""
    base = getattr(env, "base_env", env) if isinstance(env, TransformedEnv) else env
    if getattr(base, "tensor_model", None) is None:
        return f"{type(base).__name__} has no tensor_model of its own"
    for transform in transforms_of(env):
        if isinstance(transform, _COUNTING):
            continue
        keys = [unravel_key(("next", key)) for key in (*transform.in_keys, *transform.out_keys)]
        if not isinstance(transform, _OF_REWARDS) or set(keys) != {unravel_key(reward_key)}:
            return f"its {type(transform).__name__} may change more than the reward"
    return None


def find_tensor_model(env: EnvBase) -> TensorModel:
    """Return the model that a plan on ``env`` calls, where :func:`why_no_tensor_model` has none."""
    if not isinstance(env, TransformedEnv):
        return env.tensor_model
    of_rewards = [t for t in transforms_of(env) if isinstance(t, _OF_REWARDS)]
    model = env.base_env.tensor_model
    return _Rewarded(model, of_rewards) if of_rewards else model


def computed_keys(env: EnvBase) -> set[NestedKey]:
    """Return the keys that an environment computes from the others where they are missing."""
    keys = {unravel_key(key) for key in getattr(env, "computed_keys", ())}
    # It computes them from its own observations, and not from what a transform makes of these.
    read = {unravel_key(key) for key in getattr(env, "computed_from", ())}
    changed = {unravel_key(key) for t in transforms_of(env) for key in t.out_keys}
    return set() if read & changed else keys
