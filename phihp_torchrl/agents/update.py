"""Actor, critics, targets and moments as tensors: the base of every update that trains them."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import TD3Loss

from phihp_torchrl.agents.equations import Layers
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import ActionBounds


class Networks(NamedTuple):
    """The tensors that a step changes, each group a list ``[weight, bias, …]``."""

    actor: list[Tensor]
    critics: list[Tensor]
    target_actor: list[Tensor]
    target_critics: list[Tensor]
    actor_means: list[Tensor]
    actor_squares: list[Tensor]
    critic_means: list[Tensor]
    critic_squares: list[Tensor]


class ActorCriticUpdate(nn.Module):
    """The base of updates of an actor and its twin critics, whose tensors a TD3Loss holds.

    Subclasses change the parameters and targets of the :class:`~torchrl.objectives.TD3Loss` in
    place, so that checkpoints, planners and other TorchRL code can read them from the loss. The
    moments of Adam are buffers of this module.

    Args:
        loss: the loss whose parameters are trained.
        world_model: the model in which they are trained.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import TD3Config, make_td3_loss
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> update = ActorCriticUpdate(make_td3_loss(model, TD3Config()), model)
        >>> len(update.actor), len(update.critics)
        (6, 8)
    """

    steps: Tensor

    def __init__(self, loss: TD3Loss, world_model: TaskWorldModel) -> None:
        super().__init__()
        self.loss = loss
        self.world_model = world_model
        self._networks: Networks | None = None
        self._bounds: ActionBounds | None = None
        for name, group in (("actor", self.actor), ("critics", self.critics)):
            for i, layer in enumerate(group):
                self.register_buffer(f"{name}_mean_{i}", torch.zeros_like(layer))
                self.register_buffer(f"{name}_square_{i}", torch.zeros_like(layer))
        self.register_buffer("steps", torch.zeros((), dtype=torch.float64))

    @property
    def bounds(self) -> ActionBounds:
        """Bounds of the action, computed once, since that takes longer than to use them."""
        if self._bounds is None:
            self._bounds = ActionBounds.from_limits(self.loss.min_action, self.loss.max_action)
        return self._bounds

    @property
    def actor(self) -> list[Tensor]:
        """The layers of the actor, which share memory with the loss."""
        return layers(self.loss.actor_network_params)

    @property
    def critics(self) -> list[Tensor]:
        """The stacked layers of the critics, which share memory with the loss."""
        return layers(self.loss.qvalue_network_params)

    @property
    def networks(self) -> Networks:
        """Layers, targets and moments; more than fifty tensors, so they are looked up once."""
        if self._networks is None:
            self._networks = Networks(
                self.actor,
                self.critics,
                layers(self.loss.target_actor_network_params),
                layers(self.loss.target_qvalue_network_params),
                *(
                    [getattr(self, f"{name}_{moment}_{i}") for i in range(len(group))]
                    for name, group in (("actor", self.actor), ("critics", self.critics))
                    for moment in ("mean", "square")
                ),
            )
        return self._networks

    @torch.no_grad()
    def restart(self, actor: Layers, critics: Layers) -> None:
        """Continue from these layers, also as targets; the moments of Adam are not changed."""
        nets = self.networks
        for mine, given in (
            (nets.actor, actor),
            (nets.target_actor, actor),
            (nets.critics, critics),
            (nets.target_critics, critics),
        ):
            for layer, value in zip(mine, given, strict=True):
                layer.copy_(value)

    def _apply(self, *args: Any, **kwargs: Any) -> ActorCriticUpdate:
        self._networks = self._bounds = None  # the tensors may have moved to another device
        return super()._apply(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_networks": None, "_bounds": None}  # not for a copy


def learning_rate_scale(left: float, decay: float) -> float:
    """Return the factor on learning rates: 1 at first, falling to a twentieth at the end.

    Args:
        left: remaining share of the training, from 1 to 0.
        decay: share of the training, at its end, in which the factor falls; 0 for never.

    Examples:
        >>> [learning_rate_scale(left, decay=0.5) for left in (0.9, 0.25, 0.0)]
        [1.0, 0.5, 0.05]
    """
    return 1.0 if decay == 0 else max(0.05, min(1.0, left / decay))


def layers(params: TensorDictBase) -> list[Tensor]:
    """Return weights and biases of parameters of TD3Loss, detached, sharing their memory."""
    mlp = params["module", "mlp"]
    names = sorted(mlp.keys(), key=int)
    return [mlp[name, part].detach() for name in names for part in ("weight", "bias")]
