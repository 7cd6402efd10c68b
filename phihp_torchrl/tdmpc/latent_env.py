"""A learned latent model as a TorchRL environment, for planners and collectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from phihp_torchrl.imagination import GivenStarts
from phihp_torchrl.tasks import ActionBounds


class LatentEnv(GivenStarts, EnvBase):
    """Steps a model of latents as if it were the world; the observation is ``"latent"``.

    It accepts tensordicts of any batch shape, and its ``tensor_model`` lets planners call the model
    as functions. Put an encoder before the planner:
    ``TensorDictSequential(encoder, MPPIPlanner(env, ...))``. ``reset(tensordict)`` starts from the
    ``"latent"`` given there, unless ``set_state=False`` or a ``"_reset"`` mask asks for fresh ones.

    Args:
        model: with ``transition(latent, action) -> next latent, reward, terminated``, and
            ``locate`` and ``observe``, as :class:`~phihp_torchrl.planners.TensorModel` has them.
        latent_dim: components of a latent.
        bounds: bounds of the action.
        start: draws latents ``[*batch, l]`` to start from, given the batch shape.

    Examples:
        >>> class Still:
        ...     def transition(self, latent, action):
        ...         reward = latent.sum(-1)
        ...         return latent, reward, reward < -1
        >>> bounds = ActionBounds.from_limits([-1.0, 0.0], [1.0, 5.0])
        >>> env = LatentEnv(Still(), 3, bounds, start=lambda shape: torch.zeros(*shape, 3))
        >>> env.rollout(4)["next", "latent"].shape
        torch.Size([4, 3])
    """

    def __init__(
        self,
        model: Any,
        latent_dim: int,
        bounds: ActionBounds,
        *,
        start: Callable[[torch.Size], Tensor],
    ) -> None:
        super().__init__(device=bounds.low.device, batch_size=torch.Size([]))
        # Assigned without registration, because the model is a submodule of its owner already.
        object.__setattr__(self, "_latent_model", model)
        self.start = start

        def situation() -> Composite:
            latent = Unbounded(shape=(latent_dim,), device=self.device)
            return Composite(latent=latent, device=self.device)

        self.observation_spec = situation()
        self.state_spec = situation()
        self.action_spec = Bounded(low=bounds.low, high=bounds.high)
        self.reward_spec = Unbounded(shape=(1,), device=self.device)
        self.done_spec = Binary(shape=(1,), device=self.device, dtype=torch.bool)
        self._batch_locked = False

    @property
    def tensor_model(self) -> Any:
        """The model, with ``locate``, ``observe`` and ``transition`` as functions of tensors."""
        return self._latent_model

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random but ``start``."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        latent, reward, terminated = self.tensor_model.transition(
            tensordict.get("latent"), tensordict.get("action")
        )
        return self._result(latent, terminated).set("reward", reward.unsqueeze(-1))

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any
    ) -> TensorDictBase:
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        given = tensordict if set_state else None
        latent = self.start(batch) if given is None else given.get("latent").clone()
        return self._result(latent, torch.zeros_like(latent[..., 0], dtype=torch.bool))

    def _result(self, latent: Tensor, terminated: Tensor) -> TensorDict:
        terminated = terminated.unsqueeze(-1)
        return TensorDict(
            {"latent": latent, "terminated": terminated, "done": terminated.clone()},
            batch_size=latent.shape[:-1],
            device=self.device,
        )
