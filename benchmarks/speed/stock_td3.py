"""TD3 from TorchRL's parts alone: what the fused step is tested and timed against."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate, TD3Loss

from phihp_torchrl.agents import TD3Config
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Batch


class StockTD3Update:
    """The same update as :class:`TD3Update`, by autograd, two Adams and TorchRL's SoftUpdate.

    Args:
        loss: whose parameters to train.
        world_model: maps states to observations.
        config: hyper-parameters; without value expansion.
        fused: whether Adam is torch's fused one.

    Raises:
        ConfigError: for value expansion, which TD3Loss does not have.
    """

    def __init__(
        self, loss: TD3Loss, world_model: TaskWorldModel, config: TD3Config, fused: bool = False
    ) -> None:
        if config.value_expansion != 1:
            raise ConfigError("value_expansion", f"expected 1, got {config.value_expansion}.")
        self.loss, self.world_model, self.config = loss, world_model, config
        self.soft_update = SoftUpdate(loss, tau=config.tau)
        self.actor_optimizer, self.critic_optimizer = (
            torch.optim.Adam(params.flatten_keys().values(), lr=rate, fused=fused)
            for params, rate in (
                (loss.actor_network_params, config.actor_learning_rate),
                (loss.qvalue_network_params, config.critic_learning_rate),
            )
        )

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Train on ``policy_delay`` batches of equal size, given as one."""
        delay = self.config.policy_delay
        parts = zip(*(column.chunk(delay) for column in batch), strict=True)
        return self.step([self.as_tensordict(Batch(*part)) for part in parts])

    def step(self, batches: Sequence[TensorDictBase]) -> dict[str, Tensor]:
        """A critic update on each of the batches, then the actor's on the last."""
        for data in batches:
            losses = self.loss(data)
            losses["loss_qvalue"].backward()
            self.critic_optimizer.step()
            self.critic_optimizer.zero_grad()
            self.actor_optimizer.zero_grad()
        loss_actor = self.loss(data)["loss_actor"]
        loss_actor.backward()
        self.actor_optimizer.step()
        self.actor_optimizer.zero_grad()
        self.critic_optimizer.zero_grad()
        self.soft_update.step()
        return {"loss_qvalue": losses["loss_qvalue"].detach(), "loss_actor": loss_actor.detach()}

    def as_tensordict(self, batch: Batch) -> TensorDict:
        """Transitions as TD3Loss reads them."""
        shape = batch.reward.shape
        following = TensorDict(
            observation=self.world_model.observe(batch.next_state),
            reward=batch.reward.unsqueeze(-1),
            terminated=batch.terminated.unsqueeze(-1),
            done=batch.terminated.unsqueeze(-1),
            batch_size=shape,
        )
        return TensorDict(
            observation=self.world_model.observe(batch.state),
            action=batch.action,
            next=following,
            batch_size=shape,
        )
