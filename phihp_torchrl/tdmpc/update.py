"""One gradient step of TD-MPC: losses, gradients, both optimizers and the targets."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.config import check_count, check_fields, check_positive, check_positive_share
from phihp_torchrl.tdmpc.loss import TDMPCLoss, TDMPCLossConfig
from phihp_torchrl.tdmpc.networks import TOLD, TOLDConfig


@dataclass(frozen=True)
class TDMPCConfig:
    """Hyper-parameters of TD-MPC's learning.

    Args:
        learning_rate: learning rate of encoder, dynamics, reward, termination and policy.
        critic_learning_rate: the critics' learning rate (1e-4 on CartPole and Acrobot).
        max_grad_norm: largest norm of the gradients, for the model and for the policy.
        tau: step of the target networks towards the networks.
        target_interval: updates between two steps of the target networks.
        told: sizes of the networks.
        loss: weights of the losses.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> TDMPCConfig(tau=0.0)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: tau: expected a number in (0, 1], got 0.0.
    """

    learning_rate: float = 1e-3
    critic_learning_rate: float = 1e-3
    max_grad_norm: float = 10.0
    tau: float = 0.02
    target_interval: int = 1
    told: TOLDConfig = field(default_factory=TOLDConfig)
    loss: TDMPCLossConfig = field(default_factory=TDMPCLossConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        check_positive(self, "max_grad_norm")
        check_positive_share(self, "learning_rate", "critic_learning_rate")
        check_count(self, "target_interval")
        check_positive_share(self, "tau")


class TDMPCUpdate:
    """Trains :class:`TOLD` on a batch of slices.

    Args:
        told: the networks to train.
        config: hyper-parameters.
        compile: whether to compile losses and gradients (about a minute at first).

    Examples:
        >>> from phihp_torchrl import get_task
        >>> update = TDMPCUpdate(TOLD.for_task(get_task("pendulum")), TDMPCConfig())
        >>> update.updates
        0
    """

    def __init__(self, told: TOLD, config: TDMPCConfig, *, compile: bool = False) -> None:
        self.config = config
        self.loss = TDMPCLoss(told, config.loss, compile=compile)
        critics, policy = list(told.critics.parameters()), list(told.actor.parameters())
        apart = {id(p) for p in (*critics, *policy)}
        rest = [p for p in told.parameters() if id(p) not in apart]
        self._clipped = ([*rest, *critics], policy)
        groups: list[dict[str, Any]] = [
            {"params": rest},
            {"params": critics, "lr": config.critic_learning_rate},
            {"params": policy},
        ]
        self.optimizer = torch.optim.Adam(groups, lr=config.learning_rate, fused=True)
        self._rates = [group["lr"] for group in self.optimizer.param_groups]
        self.updates = 0

    def __call__(
        self,
        slices: TensorDictBase,
        learning_rate_scale: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> dict[str, Tensor]:
        """Take one step.

        Args:
            slices: what :class:`TDMPCLoss` reads, ``[N, H]``.
            learning_rate_scale: factor on all learning rates.
            generator: source of the noise on the policy's actions.

        Returns:
            The losses as detached scalars, and ``td_error`` ``[N]``, the slices' priorities.
        """
        losses = self.loss(slices, generator)
        self.optimizer.zero_grad(set_to_none=True)
        (losses["loss_model"] + losses["loss_policy"]).backward()
        for parameters in self._clipped:
            torch.nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm)
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = learning_rate_scale * rate
        self.optimizer.step()
        self.updates += 1
        if self.updates % self.config.target_interval == 0:
            self.loss.update_target(self.config.tau)
        return {name: value.detach() for name, value in losses.items()}

    def state_dict(self) -> dict[str, Any]:
        """Networks, targets, Adam's moments and the number of updates."""
        return {
            "told": self.loss.told.state_dict(),
            "target": self.loss.target.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.loss.told.load_state_dict(state["told"])
        self.loss.target.load_state_dict(state["target"])
        # A copy, because Adam keeps these tensors and changes them in place.
        self.optimizer.load_state_dict(copy.deepcopy(dict(state["optimizer"])))
        self.updates = state["updates"]
