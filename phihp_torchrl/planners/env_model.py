"""A TorchRL environment as the model of a plan: its keys, bounds and steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp


class EnvModel:
    """A stateless TorchRL environment with the interface of a tensor model; states are tensordicts.

    It is never reset: sequences whose episode has ended are stepped further, but their rewards no
    longer count.

    Args:
        env: the environment, of batch size ``[]``.
        action_key: key of the action.
        action_shape: shape of one action.
        reward_key: key of the reward after a step, with the leading ``"next"``.
        done_keys: keys of the flags that end a sequence, with the leading ``"next"``.
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
        """Return the observation, from which the environment can be stepped."""
        return observation

    def observe(self, state: TensorDictBase) -> TensorDictBase:
        """Return the state, from which actor and critic read their keys."""
        return state

    def transition(
        self, state: TensorDictBase, action: Tensor
    ) -> tuple[TensorDictBase, Tensor, Tensor]:
        """Step the environment, ``[rows]``."""
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


def find_action(env: EnvBase, key: NestedKey) -> TensorSpec:
    """Return the spec of the only, continuous action ``key``, without the batch size."""
    keys = [unravel_key(k) for k in env.action_keys]
    if keys != [key]:
        raise ValueError(f"action_key: expected the only action of {keys}, got {key!r}.")
    spec = env.full_action_spec_unbatched[key]
    if not spec.dtype.is_floating_point:
        raise ValueError(f"env: expected continuous actions, got {spec.dtype}.")
    return spec


def find_limits(spec: TensorSpec) -> tuple[Tensor, Tensor]:
    """Return the bounds ``[m]`` of an action, infinite where there are none."""
    shape = spec.shape
    if isinstance(spec, Bounded):
        limits = (spec.space.low.expand(shape), spec.space.high.expand(shape))
    else:
        limits = (torch.full(shape, -torch.inf), torch.full(shape, torch.inf))
    low, high = (t.to(dtype=spec.dtype, device=spec.device).reshape(-1).clone() for t in limits)
    return low, high


def find_reward(env: EnvBase, key: NestedKey) -> NestedKey:
    """Return ``key``, with the leading ``"next"``, if it is the key of a scalar reward."""
    keys = [unravel_key(("next", k)) for k in env.reward_keys]
    if key not in keys:
        raise ValueError(f"reward_key: expected one of {keys}, got {key!r}.")
    shape = env.full_reward_spec_unbatched[unravel_key(key[1:])].shape
    if shape.numel() != 1:
        raise ValueError(f"reward_key: expected one reward a step, got {key!r} of {list(shape)}.")
    return key


def find_done(env: EnvBase, keys: NestedKey | Sequence[NestedKey] | None) -> list[NestedKey]:
    """Return the keys of the flags that end a sequence, with the leading ``"next"``."""
    known = [unravel_key(("next", k)) for k in env.done_keys]
    if keys is None:
        return [key for key in known if key[-1] == "terminated"]
    if isinstance(keys, str) or (isinstance(keys, tuple) and unravel_key(keys) in known):
        keys = [keys]
    keys = [unravel_key(key) for key in keys]
    if unknown := [key for key in keys if key not in known]:
        raise ValueError(f"done_keys: expected some of {known}, got {unknown}.")
    return keys


def find_situation(env: EnvBase) -> dict[NestedKey, TensorSpec]:
    """Return the specs of all keys from which an environment is stepped: observations and state."""
    specs: dict[NestedKey, TensorSpec] = {}
    for spec in (env.full_observation_spec_unbatched, env.full_state_spec_unbatched):
        for key in spec.keys(True, True):
            specs.setdefault(unravel_key(key), spec[key])
    return specs
