"""TD3 as one fused step on the tensors of TorchRL's TD3Loss."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate, TD3Loss, ValueEstimators

from phihp_torchrl.agents.functional import (
    Batch,
    Layers,
    actor_loss,
    adam_,
    adam_rates,
    critic_loss,
    soft_update_,
    td3_target,
)
from phihp_torchrl.agents.networks import make_actor, make_qvalue
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.ranges import check_not_negative, check_positive, check_positive_share

_logger = logging.getLogger(__name__)


class Networks(NamedTuple):
    """All that a step changes: layers, each group ``[weight, bias, …]``."""

    actor: list[Tensor]
    critics: list[Tensor]
    target_actor: list[Tensor]
    target_critics: list[Tensor]
    actor_means: list[Tensor]
    actor_squares: list[Tensor]
    critic_means: list[Tensor]
    critic_squares: list[Tensor]


@dataclass(frozen=True)
class TD3Config:
    """Hyper-parameters of TD3 (SPEC section 3); the values are the published ones.

    Noise is in units of the action bounds.
    """

    actor_hidden_sizes: tuple[int, ...] = (300, 300)
    critic_hidden_sizes: tuple[int, ...] = (200, 200, 200)
    actor_learning_rate: float = 1e-3
    critic_learning_rate: float = 1e-4
    last_layer_scale: float = 1.0
    gamma: float = 0.99
    tau: float = 0.005
    policy_delay: int = 2
    target_noise: float = 0.1
    target_noise_clip: float = 0.5
    value_expansion: int = 1

    def __post_init__(self) -> None:
        check_positive(
            self, "actor_learning_rate", "critic_learning_rate", "policy_delay", "value_expansion"
        )
        check_positive_share(self, "gamma", "tau")
        check_not_negative(self, "target_noise", "target_noise_clip", "last_layer_scale")


def make_td3_loss(world_model: TaskWorldModel, config: TD3Config) -> TD3Loss:
    """TorchRL's TD3Loss with the published networks and noise, for the world model's task."""
    task = world_model.task
    high = torch.tensor(task.action_high)
    loss = TD3Loss(
        make_actor(task, config.actor_hidden_sizes, config.last_layer_scale),
        make_qvalue(task, config.critic_hidden_sizes),
        bounds=(-high, high),
        num_qvalue_nets=2,
        loss_function="l2",
        policy_noise=config.target_noise * high,
        noise_clip=config.target_noise_clip * high,
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
    SoftUpdate(loss, tau=config.tau)  # tells the loss that its targets are looked after
    return loss


def learning_rate_scale(left: float, decay: float) -> float:
    """A factor that stays 1, and falls with the end of a training to a twentieth.

    Args:
        left: share of the training that is left.
        decay: over which share of it, at the end, the factor falls; 0 for never.

    Examples:
        >>> [learning_rate_scale(left, decay=0.5) for left in (0.9, 0.25, 0.0)]
        [1.0, 0.5, 0.05]
    """
    return 1.0 if decay == 0 else max(0.05, min(1.0, left / decay))


class TD3Update(nn.Module):
    """``policy_delay`` critic updates, one actor update and the soft updates, as one graph.

    The tensors it changes are those of a :class:`~torchrl.objectives.TD3Loss`, which stays the
    owner of parameters and targets: checkpoints, planners and stock TorchRL code read them there.
    The moments of Adam are buffers of this module.

    Args:
        loss: whose parameters to train.
        world_model: maps states to observations and carries value expansion.
        config: hyper-parameters.
        compile: whether to compile the step (10 to 40 s at first, from the cache afterwards).

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.oracle(task))
        >>> config = TD3Config()
        >>> update = TD3Update(make_td3_loss(model, config), model, config)
        >>> state = task.coverage.sample([64])
        >>> action = torch.zeros(64, 1)
        >>> next_state, reward, terminated = model.transition(state, action)
        >>> batch = Batch(state, action, reward, next_state, terminated)
        >>> sorted(update(batch))
        ['loss_actor', 'loss_qvalue']
    """

    steps: Tensor

    def __init__(
        self,
        loss: TD3Loss,
        world_model: TaskWorldModel,
        config: TD3Config,
        *,
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.loss = loss
        self.world_model = world_model
        self.config = config
        self._networks: Networks | None = None
        for name, group in (("actor", self.actor), ("critics", self.critics)):
            for i, layer in enumerate(group):
                self.register_buffer(f"{name}_mean_{i}", torch.zeros_like(layer))
                self.register_buffer(f"{name}_square_{i}", torch.zeros_like(layer))
        self.register_buffer("steps", torch.zeros((), dtype=torch.float64))
        if compile and config.value_expansion > 1 and not world_model.compiles:
            _logger.warning("TD3 is not compiled: the model's integrator does not compile.")
            compile = False
        self._compiled_step = compile_graph(self._step, enabled=compile)

    @property
    def actor(self) -> list[Tensor]:
        """The actor's layers, the loss's own tensors."""
        return layers(self.loss.actor_network_params)

    @property
    def critics(self) -> list[Tensor]:
        """The critics' stacked layers, the loss's own tensors."""
        return layers(self.loss.qvalue_network_params)

    @property
    def networks(self) -> Networks:
        """Layers, targets and moments, looked up once: there are more than fifty of them."""
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
        """Go on from these layers, targets included; the moments of Adam stay as they are."""
        nets = self.networks
        for mine, given in (
            (nets.actor, actor),
            (nets.target_actor, actor),
            (nets.critics, critics),
            (nets.target_critics, critics),
        ):
            for layer, value in zip(mine, given, strict=True):
                layer.copy_(value)

    def _apply(self, *args: Any, **kwargs: Any) -> TD3Update:
        self._networks = None  # they may move
        return super()._apply(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_networks": None}  # a copy has its own

    @torch.no_grad()
    def forward(
        self,
        batch: Batch,
        learning_rate_scale: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> dict[str, Tensor]:
        """Train on ``policy_delay`` batches of equal size, given as one.

        Args:
            batch: transitions, ``[policy_delay * N]`` rows: ``N`` for each critic update, of which
                the last also serve the actor's.
            learning_rate_scale: factor on both learning rates.
            generator: source of the target policy's noise.

        Returns:
            ``loss_qvalue`` and ``loss_actor``, detached scalars.

        Raises:
            ValueError: if the rows do not divide by ``policy_delay``.
        """
        config, rows = self.config, len(batch.reward)
        if rows == 0 or rows % config.policy_delay:
            raise ValueError(
                f"batch: expected a multiple of policy_delay = {config.policy_delay} rows, "
                f"got {rows}."
            )
        high = self.loss.max_action
        noise = torch.randn(batch.action.shape, generator=generator, device=high.device)
        clip = config.target_noise_clip
        updates = torch.arange(1, config.policy_delay + 1, device=high.device)
        loss_qvalue, loss_actor = self._compiled_step(
            batch,
            (config.target_noise * noise).clamp(-clip, clip) * high,
            adam_rates(self.steps + 1, learning_rate_scale * config.actor_learning_rate),
            adam_rates(
                self.steps * config.policy_delay + updates,
                learning_rate_scale * config.critic_learning_rate,
            ),
            high,
            self.networks,
        )
        self.steps += 1
        return {"loss_qvalue": loss_qvalue, "loss_actor": loss_actor}

    def _step(
        self,
        batch: Batch,
        noise: Tensor,
        actor_rates: tuple[Tensor, Tensor],
        critic_rates: tuple[Tensor, Tensor],
        high: Tensor,
        nets: Networks,
    ) -> tuple[Tensor, Tensor]:
        config, observe = self.config, self.world_model.observe
        # The targets stand still until the soft update, so all batches share one pass for them.
        target = td3_target(
            batch,
            nets.target_actor,
            nets.target_critics,
            noise,
            high,
            config.gamma,
            observe,
            self.world_model.transition,
            config.value_expansion,
        )
        parts = (part.chunk(config.policy_delay) for part in (batch.state, batch.action, target))
        for i, (state, action, value) in enumerate(zip(*parts, strict=True)):
            observation = observe(state)
            gradients, loss_qvalue = torch.func.grad_and_value(critic_loss)(
                nets.critics, observation, action, value, high
            )
            rates = (rate[i] for rate in critic_rates)
            adam_(nets.critics, gradients, nets.critic_means, nets.critic_squares, *rates)
        gradients, loss_actor = torch.func.grad_and_value(actor_loss)(
            nets.actor, nets.critics, observation, high
        )
        adam_(nets.actor, gradients, nets.actor_means, nets.actor_squares, *actor_rates)
        soft_update_(nets.target_actor, nets.actor, config.tau)
        soft_update_(nets.target_critics, nets.critics, config.tau)
        return loss_qvalue, loss_actor


def layers(params: TensorDictBase) -> list[Tensor]:
    """The weights and biases of TD3Loss parameters, detached but the same memory."""
    mlp = params["module", "mlp"]
    names = sorted(mlp.keys(), key=int)
    return [mlp[name, part].detach() for name in names for part in ("weight", "bias")]
