"""A TorchRL environment as the model of a plan: its keys, bounds and steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from phihp_torchrl.config import ConfigError


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
        """Step the environment, ``[rows]``, as :meth:`take` does."""
        return self.take(state, action)[1:]

    def take(
        self, state: TensorDictBase, action: Tensor
    ) -> tuple[TensorDictBase, TensorDictBase, Tensor, Tensor]:
        """Step the environment; return the step, the next state, reward and end ``[rows]``.

        Rewards of whole numbers become those of the action's dtype, and flags become bools.

        Raises:
            ConfigError: for a reward or a flag that is not one number for each row.
        """
        rows = action.shape[0]
        # Copied whole: an environment may work in place, and candidates share one first state.
        state = state.copy().set(self.action_key, action.reshape(rows, *self.action_shape)).clone()
        state = self.env.step(state)
        reward = self._one_each(state, self.reward_key, rows)
        reward = reward if reward.is_floating_point() else reward.to(action.dtype)
        over = torch.zeros_like(reward, dtype=torch.bool)
        for key in self.done_keys:
            over = over | self._one_each(state, key, rows).to(torch.bool)
        next_state = step_mdp(
            state,
            reward_keys=self.env.reward_keys,
            done_keys=self.env.done_keys,
            action_keys=self.env.action_keys,
        )
        return state, next_state, reward, over

    def _one_each(self, state: TensorDictBase, key: NestedKey, rows: int) -> Tensor:
        value = state.get(key)
        if value.numel() != rows:
            raise ConfigError(
                "env", f"expected one {key!r} for each of {rows} rows, got {list(value.shape)}."
            )
        return value.reshape(rows)


def find_action(env: EnvBase, key: NestedKey) -> TensorSpec:
    """Return the spec of the only, continuous action ``key``, without the batch size."""
    keys = [unravel_key(k) for k in env.action_keys]
    if keys != [key]:
        raise ConfigError("action_key", f"expected the only action of {keys}, got {key!r}.")
    spec = env.full_action_spec_unbatched[key]
    if not spec.dtype.is_floating_point or spec.domain == "discrete":
        raise ConfigError(
            "env", f"expected continuous actions, got {spec.dtype} of a {type(spec).__name__}."
        )
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
    """Return the keys of the flags that end a sequence, with the leading ``"next"``.

    A key may be given without the leading ``"next"`` too.
    """
    known = [unravel_key(("next", k)) for k in env.done_keys]
    if keys is None:
        return [key for key in known if key[-1] == "terminated"]
    if isinstance(keys, str) or (isinstance(keys, tuple) and _named(keys, known) in known):
        keys = [keys]
    keys = [_named(key, known) for key in keys]
    if unknown := [key for key in keys if key not in known]:
        raise ValueError(f"done_keys: expected some of {known}, got {unknown}.")
    return keys


def _named(key: NestedKey, known: Sequence[NestedKey]) -> NestedKey:
    following = unravel_key(("next", key))
    return following if following in known else unravel_key(key)


def find_situation(env: EnvBase) -> dict[NestedKey, TensorSpec]:
    """Return the specs of all keys from which an environment is stepped: observations and state."""
    specs: dict[NestedKey, TensorSpec] = {}
    for spec in (env.full_observation_spec_unbatched, env.full_state_spec_unbatched):
        for key in spec.keys(True, True):
            specs.setdefault(unravel_key(key), spec[key])
    return specs
