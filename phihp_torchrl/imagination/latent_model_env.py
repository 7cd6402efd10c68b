"""Any TorchRL world model as an environment that steps in its latents, of any batch shape."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.modules import WorldModel

from phihp_torchrl.config import ConfigError, check_choice
from phihp_torchrl.imagination.given_starts import GivenStarts

_THRESHOLDS = {"probability": 0.5, "logit": 0.0}


class LatentModelEnv(GivenStarts, ModelBasedEnvBase):
    """Steps a :class:`torchrl.modules.WorldModel` in its latents, for planners and rollouts.

    It accepts tensordicts of any batch shape, which planners need and
    :class:`torchrl.envs.model_based.WorldModelEnv` does not. Its observations are the latents,
    which are the keys that the model's dynamics read besides the action, and what else the model
    writes under ``"next"``. Put the encoder before a planner:
    ``TensorDictSequential(world_model.encoder, CEMPlanner(env, ...))``.

    ``reset(tensordict)`` starts from the latents given, or encodes the observations given.

    Args:
        world_model: the model; later changes of its parameters take effect at once.
        base_env: an environment whose specs of action, reward and flags the model has, and whose
            observations are what the encoder reads, or the latents. It is never stepped.
        start: makes a tensordict of observations or latents to start from, given the batch shape.
            Without it, every start has to be given.
        done: what a flag that is no bool says: the ``"probability"`` of an end, which above 0.5 is
            one, or its ``"logit"``.

    Raises:
        ConfigError: if the model does not fit ``base_env``, or a reset has nothing to start from.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torch import nn
        >>> from torchrl.envs import PendulumEnv
        >>> class Mix(nn.Linear):
        ...     def forward(self, *parts):
        ...         return super().forward(torch.cat(parts, -1))
        >>> class Stack(nn.Module):
        ...     def forward(self, *parts):
        ...         return torch.stack(parts, -1)
        >>> z, reward = ("next", "z"), ("next", "reward")
        >>> model = WorldModel(
        ...     encoder=TensorDictModule(Stack(), ["th", "thdot"], ["z"]),
        ...     dynamics=TensorDictModule(Mix(3, 2), ["z", "action"], [z]),
        ...     reward_head=TensorDictModule(nn.Linear(2, 1), [z], [reward]),
        ... )
        >>> env = LatentModelEnv(model, PendulumEnv())
        >>> start = TensorDict(th=torch.zeros(5), thdot=torch.zeros(5), batch_size=[5])
        >>> env.rollout(3, tensordict=start)["next", "z"].shape
        torch.Size([5, 3, 2])
    """

    def __init__(
        self,
        world_model: WorldModel,
        base_env: EnvBase,
        *,
        start: Callable[[torch.Size], TensorDictBase] | None = None,
        done: str = "probability",
    ) -> None:
        super().__init__(
            world_model.step_module, device=base_env.device or "cpu", batch_size=torch.Size([])
        )
        self._world_model, self.start, self.done = world_model, start, done
        check_choice(self, "done", tuple(_THRESHOLDS))
        self.action_spec = base_env.full_action_spec_unbatched.clone()
        self.reward_spec = base_env.full_reward_spec_unbatched.clone()
        self.done_spec = base_env.full_done_spec_unbatched.clone()
        self._actions = [unravel_key(key) for key in base_env.action_keys]
        read = [unravel_key(key) for key in world_model.step_module.in_keys]
        self.latent_keys = [key for key in read if key not in self._actions and key[0] != "next"]
        self._encoded_keys = [unravel_key(key) for key in world_model.encoder.in_keys]
        self._set_observation_spec(base_env)

    def _set_observation_spec(self, base_env: EnvBase) -> None:
        """Take one step from zeros, which shows what the model writes."""
        seen = base_env.full_observation_spec_unbatched.zero().expand(1).clone()
        missing = [key for key in self._encoded_keys if seen.get(key, None) is None]
        shows_latents = all(seen.get(key, None) is not None for key in self.latent_keys)
        if missing and not shows_latents:
            keys = list(seen.keys(True, True))
            raise ConfigError("base_env", f"expected observations {missing}, got {keys}.")
        with torch.no_grad():
            encoded = seen if shows_latents else self._world_model.encode(seen)
            if lost := [key for key in self.latent_keys if encoded.get(key, None) is None]:
                raise ConfigError(
                    "world_model", f"expected an encoder that writes {lost}, which the model reads."
                )
            latents = encoded.select(*self.latent_keys)
            acting = self.full_action_spec.zero().expand(1).clone()
            after = self.world_model(latents.copy().update(acting)).get("next")
        known = [unravel_key(key) for key in (*self.reward_keys, *self.done_keys)]
        shown = {unravel_key(key): after.get(key) for key in after.keys(True, True)}
        if never := [key for key in self.latent_keys if key not in shown]:
            raise ConfigError("world_model", f"expected dynamics that write {never} under 'next'.")
        if self.reward_keys and not any(unravel_key(k) in shown for k in self.reward_keys):
            raise ConfigError("world_model", f"expected a reward head that writes {known[0]!r}.")
        self.observation_spec = self._specs({k: v for k, v in shown.items() if k not in known})
        self.state_spec = self._specs({key: shown[key] for key in self.latent_keys})

    def _specs(self, values: dict[NestedKey, Tensor]) -> Composite:
        """The specs of rows, without their batch dimension."""
        specs = Composite(device=self.device)
        for key, value in values.items():
            specs[key] = Unbounded(shape=value.shape[1:], dtype=value.dtype, device=self.device)
        return specs

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = self.world_model(tensordict.copy()).get("next")
        found = TensorDict(batch_size=tensordict.batch_size, device=self.device)
        for key in (*self.observation_spec.keys(True, True), *self.reward_keys):
            found.set(key, after.get(key))
        flags = {key: after.get(key, None) for key in self.done_keys}
        known = {k: self._flag(v) for k, v in flags.items() if v is not None}
        for key, spec in self.full_done_spec.items(True, True):
            if unravel_key(key) in known:
                value = known[unravel_key(key)]
            elif _is(key, "truncated") or not known:
                value = spec.zero(tensordict.batch_size)
            else:  # what ends an episode is both done and terminated
                value = next(iter(known.values())).clone()
            found.set(key, value.reshape(*tensordict.batch_size, *spec.shape))
        return found

    def _flag(self, value: Tensor) -> Tensor:
        return value if value.dtype is torch.bool else value > _THRESHOLDS[self.done]

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any
    ) -> TensorDictBase:
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        given = tensordict
        if not set_state or given is None:
            if self.start is None:
                raise ConfigError(
                    "start",
                    f"expected latents {self.latent_keys} or observations {self._encoded_keys} in "
                    "the reset's tensordict, or a function that makes them, got none.",
                )
            given = self.start(batch)
        if not all(given.get(key, None) is not None for key in self.latent_keys):
            given = self._world_model.encode(given.select(*self._encoded_keys))
        found = given.select(*self.latent_keys)
        specs = (self.observation_spec, self.full_done_spec)
        for key, spec in (item for group in specs for item in group.items(True, True)):
            if found.get(key, None) is None:
                found.set(key, spec.zero(batch))
        return found

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        if tensordict is None or "_reset" in tensordict:
            return False
        keys = {unravel_key(key) for key in tensordict.keys(True, True)}
        return keys >= set(self.latent_keys) or keys >= set(self._encoded_keys)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random but ``start``."""


def _is(key: NestedKey, name: str) -> bool:
    return (key if isinstance(key, str) else key[-1]) == name
