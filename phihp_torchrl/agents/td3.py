"""TD3 as one compiled step on the tensors of TorchRL's TD3Loss (arXiv:1802.09477)."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor
from torchrl.objectives import SoftUpdate, TD3Loss, ValueEstimators

from phihp_torchrl.agents.equations import (
    actor_loss,
    adam_,
    adam_rates,
    critic_loss,
    soft_update_,
    td3_target,
)
from phihp_torchrl.agents.gradients import grad_and_value
from phihp_torchrl.agents.networks import make_actor, make_qvalue
from phihp_torchrl.agents.update import ActorCriticUpdate, Networks
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.config import (
    Discount,
    Steps,
    check_count,
    check_discount,
    check_fields,
    check_not_negative,
    check_positive_share,
    check_steps,
    check_widths,
    resolve_seconds,
)
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Batch
from phihp_torchrl.tasks import ActionBounds

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TD3Config:
    """Hyper-parameters of TD3 (paper, section 4.2; ``preset=paper`` has the published values).

    Args:
        actor_hidden_sizes: widths of the actor's hidden layers (paper: 2 x 300).
        critic_hidden_sizes: widths of each critic's hidden layers (paper: 3 x 200).
        actor_learning_rate: learning rate of the actor.
        critic_learning_rate: learning rate of the critics.
        last_layer_scale: factor on the initial weights of the actor's last layer.
        gamma: discount γ, or its time constant, such as "5 s".
        tau: step τ of the target networks towards the networks, in each update of the actor.
        policy_delay: critic updates for each update of the actor.
        target_noise: std of the noise on target actions, in units of the action's half-range.
        target_noise_clip: largest absolute value of that noise, in the same units.
        value_expansion: number of rewards in the value target; the first is that of the transition,
            the others come from the model (Acrobot needs 5). Or their duration, such as
            "0.2 s".
        saturation_cost: price of saturated actions in the actor's loss: of the square of outputs
            beyond 2 before their tanh, in standard deviations of the values of a batch. It keeps an
            actor learning that has met no reward so far; 0 for none.
        change_cost: price of the change of the actor's action from a state to the next, squared, in
            half-ranges, in the same units; 0 for none. It keeps an actor calm where values hardly
            tell one action from another, as at rest.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> TD3Config(gamma=1.5)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: gamma: expected a number in (0, 1], or a time constant \
such as '5 s', got 1.5.
    """

    actor_hidden_sizes: tuple[int, ...] = (300, 300)
    critic_hidden_sizes: tuple[int, ...] = (200, 200, 200)
    actor_learning_rate: float = 3e-4
    critic_learning_rate: float = 1e-3
    last_layer_scale: float = 0.1
    gamma: Discount = 0.99
    tau: float = 0.02
    policy_delay: int = 2
    target_noise: float = 0.1
    target_noise_clip: float = 0.5
    value_expansion: Steps = 1
    saturation_cost: float = 0.0
    change_cost: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_widths(self, "actor_hidden_sizes", "critic_hidden_sizes")
        check_positive_share(self, "actor_learning_rate", "critic_learning_rate")
        check_count(self, "policy_delay")
        check_steps(self, "value_expansion")
        check_discount(self, "gamma")
        check_positive_share(self, "tau")
        check_not_negative(self, "target_noise", "target_noise_clip", "last_layer_scale")
        check_not_negative(self, "saturation_cost", "change_cost")


def make_td3_loss(world_model: TaskWorldModel, config: TD3Config) -> TD3Loss:
    """Make TorchRL's TD3Loss with networks and noise by ``config``, for the world model's task.

    Args:
        world_model: the model; its task has the sizes and the bounds of the action.
        config: hyper-parameters.

    Returns:
        A :class:`torchrl.objectives.TD3Loss` with two critics and target networks.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> loss = make_td3_loss(model, TD3Config(actor_hidden_sizes=(8,)))
        >>> [tuple(layer.shape) for layer in TD3Update(loss, model, TD3Config()).actor]
        [(8, 3), (8,), (1, 8), (1,)]
    """
    task = world_model.task
    config = resolve_seconds(config, task.time_step)
    bounds = task.bounds
    loss = TD3Loss(
        make_actor(task, config.actor_hidden_sizes, config.last_layer_scale),
        make_qvalue(task, config.critic_hidden_sizes),
        bounds=(bounds.low, bounds.high),
        num_qvalue_nets=2,
        loss_function="l2",
        policy_noise=config.target_noise * bounds.scale,
        noise_clip=config.target_noise_clip * bounds.scale,
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
    SoftUpdate(loss, tau=config.tau)  # marks the targets as updated, without which the loss warns
    return loss


class TD3Update(ActorCriticUpdate):
    """One step of TD3 as one graph: ``policy_delay`` critic updates, an actor update, soft updates.

    The step changes the parameters and targets of a :class:`~torchrl.objectives.TD3Loss` in place,
    so that checkpoints, planners and other TorchRL code can read them from the loss. The moments of
    Adam are buffers of this module.

    Args:
        loss: the loss whose parameters are trained.
        world_model: the model, which maps states to observations and computes value expansion.
        config: hyper-parameters.
        compile: whether to compile the step (10 to 40 s the first time, from the cache afterwards).

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> config = TD3Config()
        >>> update = TD3Update(make_td3_loss(model, config), model, config)
        >>> state = task.coverage.sample([64])
        >>> action = torch.zeros(64, 1)
        >>> next_state, reward, terminated = model.transition(state, action)
        >>> batch = Batch(state, action, reward, next_state, terminated)
        >>> sorted(update(batch))
        ['loss_actor', 'loss_qvalue']
    """

    def __init__(
        self,
        loss: TD3Loss,
        world_model: TaskWorldModel,
        config: TD3Config,
        *,
        compile: bool = False,
    ) -> None:
        super().__init__(loss, world_model)
        self.config = config = resolve_seconds(config, world_model.task.time_step)
        if compile and config.value_expansion > 1 and not world_model.compiles:
            _logger.warning("TD3 is not compiled: the model's integrator does not compile.")
            compile = False
        self._compiled_step = compile_graph(self._step, enabled=compile)

    @torch.no_grad()
    def forward(
        self,
        batch: Batch,
        learning_rate_scale: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> dict[str, Tensor]:
        """Train on ``policy_delay`` batches of equal size, concatenated in ``batch``.

        Args:
            batch: transitions, ``[policy_delay * N]`` rows: ``N`` for each critic update; the last
                ``N`` are used for the actor update too.
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
        bounds = self.bounds
        noise = torch.randn(batch.action.shape, generator=generator, device=bounds.low.device)
        clip = config.target_noise_clip
        updates = torch.arange(1, config.policy_delay + 1, device=bounds.low.device)
        loss_qvalue, loss_actor = self._compiled_step(
            batch,
            (config.target_noise * noise).clamp(-clip, clip) * bounds.scale,
            adam_rates(self.steps + 1, learning_rate_scale * config.actor_learning_rate),
            adam_rates(
                self.steps * config.policy_delay + updates,
                learning_rate_scale * config.critic_learning_rate,
            ),
            bounds,
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
        bounds: ActionBounds,
        nets: Networks,
    ) -> tuple[Tensor, Tensor]:
        config, observe = self.config, self.world_model.observe
        # The targets do not change before the soft update, so one pass computes them for all rows.
        target = td3_target(
            batch,
            nets.target_actor,
            nets.target_critics,
            noise,
            bounds,
            config.gamma,
            observe,
            self.world_model.transition,
            config.value_expansion,
        )
        parts = (part.chunk(config.policy_delay) for part in (batch.state, batch.action, target))
        for i, (state, action, value) in enumerate(zip(*parts, strict=True)):
            observation = observe(state)
            gradients, loss_qvalue = grad_and_value(
                critic_loss, nets.critics, observation, action, value, bounds
            )
            rates = (rate[i] for rate in critic_rates)
            adam_(nets.critics, gradients, nets.critic_means, nets.critic_squares, *rates)
        following = batch.next_state.chunk(config.policy_delay)[-1] if config.change_cost else None
        gradients, loss_actor = grad_and_value(
            actor_loss,
            nets.actor,
            nets.critics,
            observation,
            bounds,
            config.saturation_cost,
            config.change_cost,
            None if following is None else observe(following),
        )
        adam_(nets.actor, gradients, nets.actor_means, nets.actor_squares, *actor_rates)
        soft_update_(nets.target_actor, nets.actor, config.tau)
        soft_update_(nets.target_critics, nets.critics, config.tau)
        return loss_qvalue, loss_actor
