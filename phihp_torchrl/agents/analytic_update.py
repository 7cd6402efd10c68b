"""One update by policy gradients through the model, on the tensors of TorchRL's TD3Loss."""

from __future__ import annotations

import logging
from typing import NamedTuple

import torch
from torch import Tensor
from torchrl.objectives import TD3Loss

from phihp_torchrl.agents.analytic import (
    followed,
    imagine_step,
    lambda_returns,
    limited,
    pull_step,
    state_values,
)
from phihp_torchrl.agents.analytic_config import AnalyticConfig
from phihp_torchrl.agents.equations import adam_, adam_rates, critic_loss, soft_update_
from phihp_torchrl.agents.gradients import grad_and_value
from phihp_torchrl.agents.update import ActorCriticUpdate, Networks
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Batch
from phihp_torchrl.tasks import ActionBounds

_logger = logging.getLogger(__name__)

# The range of returns is that of the central 90 %, averaged over about 100 updates.
_TAIL, _MEMORY = 0.05, 0.99
_SMALLEST_RANGE = 1e-6
# The first gradients are by far the largest; Adam's usual decay rates would remember them for long.
_ACTOR_BETAS = (0.7, 0.95)


class Draws(NamedTuple):
    """All random numbers of an update, drawn outside its graphs so that seeds reproduce."""

    start_states: Tensor
    """The state from which a world continues if its episode ends there, ``[H, N, n]``; its
    references and inputs are those after the step in any case."""
    noise: Tensor
    """Noise before the actor's tanh, ``[H, N, m]``."""
    order: Tensor
    """The order in which the critics learn the imagined steps, a permutation ``[H * N]``."""


class AnalyticUpdate(ActorCriticUpdate):
    """One update by policy gradients through the model (SHAC, arXiv:2204.07137).

    Worlds are stepped ``horizon`` times under the noisy actor. The gradient of their returns is
    carried back through the model and moves the actor; the critics learn the TD(λ) returns of the
    same steps. A step forwards, a step backwards and the updates of the networks are each one
    graph, since one of all steps took minutes to compile.

    Args:
        loss: the loss whose parameters are trained.
        world_model: the model, through which the gradients go.
        config: hyper-parameters.
        gamma: discount.
        compile: whether to compile.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import TD3Config, make_td3_loss
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> loss = make_td3_loss(model, TD3Config())
        >>> update = AnalyticUpdate(loss, model, AnalyticConfig(horizon=2), gamma=0.99)
        >>> state, starts = task.coverage.sample([8]), task.coverage.sample([2, 8])
        >>> draws = Draws(starts, torch.zeros(2, 8, 1), torch.arange(16))
        >>> batch, state, metrics = update(state, draws)
        >>> batch.state.shape, sorted(metrics)
        (torch.Size([16, 2]), ['gradient_norm', 'limited_share', 'loss_qvalue', 'return_range'])
    """

    return_range: Tensor

    def __init__(
        self,
        loss: TD3Loss,
        world_model: TaskWorldModel,
        config: AnalyticConfig,
        gamma: float,
        *,
        compile: bool = False,
    ) -> None:
        super().__init__(loss, world_model)
        self.config = resolve_seconds(config, world_model.task.time_step)
        self.gamma = gamma
        self.register_buffer("return_range", torch.zeros_like(self.actor[0][0, 0]))
        if compile and not world_model.compiles:
            _logger.warning("Updates are not compiled: the model's integrator does not compile.")
            compile = False
        self._forth = compile_graph(self._step_forth, enabled=compile)
        self._back = compile_graph(self._step_back, enabled=compile)
        self._judge = compile_graph(self._evaluate, enabled=compile)
        self._learn = compile_graph(self._train, enabled=compile)

    @torch.no_grad()
    def forward(
        self, state: Tensor, draws: Draws, learning_rate_scale: float = 1.0
    ) -> tuple[Batch, Tensor, dict[str, Tensor]]:
        """Imagine ``horizon`` steps from states ``[N, n]``, and learn from them.

        Args:
            state: the states of the worlds.
            draws: the random numbers of the update.
            learning_rate_scale: factor on both learning rates and the entropy.

        Returns:
            The transitions ``[H * N]``, the new states of the worlds ``[N, n]``, and scalars:
            ``loss_qvalue``; ``gradient_norm`` before it is limited, for returns in units of their
            range; ``limited_share``, the share of steps whose gradient was limited; and
            ``return_range``.
        """
        config, nets, bounds = self.config, self.networks, self.bounds
        steps: list[Batch] = []
        for start, noise in zip(*draws[:2], strict=True):
            batch, state = self._forth(nets.actor, state, noise, start, bounds)
            steps.append(batch)
        whole = Batch(*(torch.stack(part) for part in zip(*steps, strict=True)))
        target, adjoint = self._judge(
            nets.actor, nets.target_critics, whole.next_state, whole.reward, whole.terminated,
            bounds,
        )  # fmt: skip
        limit = config.step_limit * self._range(target)
        gradients, shares = [], []
        for step, noise in zip(reversed(steps), draws.noise.flip(0), strict=True):
            adjoint, gradient, hit = self._back(
                nets.actor, step.state, noise, adjoint, step.terminated, limit, bounds
            )
            gradients.append(gradient)
            shares.append(hit)
        flat = Batch(*(part.flatten(0, 1) for part in whole))
        counts = torch.arange(1, config.critic_updates + 1, device=state.device)
        loss_qvalue, norm = self._learn(
            flat.state,
            flat.action,
            target.flatten(),
            draws.noise.flatten(0, 1),
            torch.stack(gradients[::-1]).flatten(0, 1) / self.return_range,
            draws.order,
            self.return_range.new_tensor(learning_rate_scale * config.entropy),
            adam_rates(
                self.steps + 1,
                learning_rate_scale * config.actor_learning_rate,
                betas=_ACTOR_BETAS,
            ),
            adam_rates(
                self.steps * config.critic_updates + counts,
                learning_rate_scale * config.critic_learning_rate,
            ),
            bounds,
            nets,
        )
        self.steps += 1
        metrics = {
            "loss_qvalue": loss_qvalue,
            "gradient_norm": norm,
            "limited_share": torch.stack(shares).to(target.dtype).mean(),
            "return_range": self.return_range.clone(),
        }
        return flat, state, metrics

    def _range(self, target: Tensor) -> Tensor:
        """Average range of returns, whose first value is that of the first update."""
        found = target.flatten().quantile(1 - _TAIL) - target.flatten().quantile(_TAIL)
        found = torch.where(found.isfinite(), found, self.return_range)
        mean = torch.where(self.steps == 0, found, torch.lerp(found, self.return_range, _MEMORY))
        return self.return_range.copy_(mean.clamp_min(_SMALLEST_RANGE))

    def _step_forth(
        self,
        actor: list[Tensor],
        state: Tensor,
        noise: Tensor,
        start: Tensor,
        bounds: ActionBounds,
    ) -> tuple[Batch, Tensor]:
        step = imagine_step(self.world_model, actor, state, noise, bounds)
        following, task = step.next_state, self.world_model.task
        if task.outside:  # moved by no action, so gradients are what they would be without
            signals = task.split(start)[1][..., : task.outside.size]
            following = task.with_signals(following, signals)
        batch = Batch(state, step.action, step.reward, following, step.terminated)
        return batch, torch.where(step.terminated.unsqueeze(-1), start, following)

    def _evaluate(
        self,
        actor: list[Tensor],
        critics: list[Tensor],
        next_state: Tensor,
        reward: Tensor,
        terminated: Tensor,
        bounds: ActionBounds,
    ) -> tuple[Tensor, Tensor]:
        """TD(λ) returns ``[H, N]``, and the gradient of the value beyond the horizon ``[N, n]``."""

        def values(state: Tensor) -> Tensor:
            return state_values(self.world_model, actor, critics, state, bounds)

        value = values(next_state.flatten(0, 1)).view_as(reward)
        adjoint = torch.func.grad(lambda state: values(state).sum())(next_state[-1])
        target = lambda_returns(reward, value, terminated, self.gamma, self.config.trace)
        return target, adjoint

    def _step_back(
        self,
        actor: list[Tensor],
        state: Tensor,
        noise: Tensor,
        adjoint: Tensor,
        terminated: Tensor,
        limit: Tensor,
        bounds: ActionBounds,
    ) -> tuple[Tensor, Tensor, Tensor]:
        alive = self.gamma * (1.0 - terminated.to(adjoint.dtype)).unsqueeze(-1)
        return pull_step(self.world_model, actor, state, noise, alive * adjoint, limit, bounds)

    def _train(
        self,
        state: Tensor,
        action: Tensor,
        target: Tensor,
        noise: Tensor,
        gradient: Tensor,
        order: Tensor,
        entropy: Tensor,
        actor_rates: tuple[Tensor, Tensor],
        critic_rates: tuple[Tensor, Tensor],
        bounds: ActionBounds,
        nets: Networks,
    ) -> tuple[Tensor, Tensor]:
        config = self.config
        observation = self.world_model.observe(state)
        moves, norm = limited(
            grad_and_value(followed, nets.actor, observation, noise, gradient, bounds, entropy)[0],
            config.norm_limit,
        )
        rows = (part[order].chunk(config.critic_updates) for part in (observation, action, target))
        for i, (seen, done, value) in enumerate(zip(*rows, strict=True)):
            slopes, loss = grad_and_value(critic_loss, nets.critics, seen, done, value, bounds)
            rates = (rate[i] for rate in critic_rates)
            adam_(nets.critics, slopes, nets.critic_means, nets.critic_squares, *rates)
        adam_(
            nets.actor,
            moves,
            nets.actor_means,
            nets.actor_squares,
            *actor_rates,
            betas=_ACTOR_BETAS,
        )
        soft_update_(nets.target_critics, nets.critics, config.tau)
        soft_update_(nets.target_actor, nets.actor, 1.0)
        return loss, norm
