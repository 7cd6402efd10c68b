"""Critics fitted to returns in the model, which TD3's temporal-difference targets lag behind."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.agents.equations import (
    Layers,
    act,
    adam_,
    adam_rates,
    critic_loss,
    q_values,
)
from phihp_torchrl.agents.gradients import grad_and_value
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.config import (
    Steps,
    check_count,
    check_fields,
    check_memory,
    check_positive_share,
    check_steps,
    resolve_seconds,
)
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts, finite_transition
from phihp_torchrl.tasks import ActionBounds

DOING = "fitting the critics to returns"
"""What a run says that it is doing while this is on its stack."""

# Half of the actions are near the actor's, where actor and planner compare values; the others come
# from the replay buffer, so that the critics are accurate for other actions too.
_OWN_SHARE = 0.5
_OWN_NOISE = 0.1
# Smallest mean of 1 - gamma^k by which the lag is divided.
_SMALLEST_WEIGHT = 1e-2


@dataclass(frozen=True)
class RefitConfig:
    """When and how the critics are fitted to returns in the model.

    Args:
        start: critic updates before the critics are first fitted to returns in the model, from
            where learning then goes on; 0 for one fit at the end only.
        interval: critic updates between two such fits, and any number above 0 for the one at the
            end; 0 for no fit.
        transitions: number of actions whose returns are imagined.
        horizon: model steps in a return, after which the value of the critics is added, or their
            duration, such as "4 s".
        steps: steps of Adam in a fit, with cosine decay of the learning rate.
        batch_size: returns in a step of Adam.
        learning_rate: initial learning rate of Adam.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> config = RefitConfig(start=4000, interval=2000)
        >>> [config.is_due(updates, total=9000) for updates in (2000, 4000, 5000, 6000, 9000)]
        [False, True, False, True, True]
    """

    start: int = 0
    interval: int = 2000
    transitions: int = 16384
    horizon: Steps = 100
    steps: int = 1500
    batch_size: int = 512
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        check_fields(self)
        check_steps(self, "horizon")
        check_count(self, "transitions", "steps", "batch_size")
        check_count(self, "start", "interval", least=0)
        check_positive_share(self, "learning_rate")
        check_memory(self, "transitions", "horizon")
        check_memory(self, "batch_size")

    def is_due(self, updates: int, total: int) -> bool:
        """Whether the critics are fitted after ``updates`` of ``total`` updates."""
        if not self.interval:
            return False
        return updates >= total or (
            updates >= self.start > 0 and (updates - self.start) % self.interval == 0
        )

    def fits(self, total: float) -> float:
        """How many fits there are in ``total`` updates, about.

        Examples:
            >>> RefitConfig().fits(9000), RefitConfig(start=4000, interval=2000).fits(9000)
            (1.0, 3.5)
        """
        if not self.interval:
            return 0.0
        return 1.0 + (max(0.0, total - self.start) / self.interval if self.start else 0.0)


class Refit(NamedTuple):
    """The result of fitting the critics to returns.

    Attributes:
        critics: the fitted layers.
        lag: average difference by which the values were too low before the fit.
        error_before: standard deviation of the error of the values before the fit, without the lag.
        error_after: standard deviation of the error of the values after the fit.
    """

    critics: list[Tensor]
    lag: float
    error_before: float
    error_after: float


class CriticRefit:
    r"""Fits the critics of an actor to its returns in the model (policy evaluation).

    .. math::
        y = \sum_{i<k} \gamma^i r_i + \gamma^k (\bar Q(s_k, \pi(s_k)) + c)

    The first action is given, the following ones are the actor's; :math:`\bar Q` is the mean of the
    critics before the fit. Temporal-difference targets pass on the fraction :math:`\gamma` of a
    value, and the target networks follow slowly, so after n updates all values are still too low by
    a fraction of about :math:`e^{-\tau (1 - \gamma) n}`. The lag c is the constant that makes the
    critics agree with the returns on average; it is computed once and not fitted. The returns are
    imagined in the model, so no real step is spent. Both critics are fitted to the same target,
    without the minimum over critics that makes TD3 underestimate.

    This is not in the paper; see docs/imagination.md.

    Args:
        world_model: the model.
        rollouts: rollouts of the actor in the same model, for the returns.
        config: when and how the critics are fitted.
        gamma: discount.
        compile: whether to compile a step of the fit.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import TD3Config, TD3Update, make_td3_loss
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> update = TD3Update(make_td3_loss(model, TD3Config()), model, TD3Config())
        >>> rollouts = Rollouts(model, act, max_age=200)
        >>> refit = CriticRefit(model, rollouts, RefitConfig(transitions=64, steps=2), 0.99)
        >>> state, action = task.coverage.sample([64]), torch.zeros(64, 1)
        >>> len(refit(update.actor, update.critics, state, action).critics)
        8
    """

    def __init__(
        self,
        world_model: TaskWorldModel,
        rollouts: Rollouts,
        config: RefitConfig,
        gamma: float,
        *,
        compile: bool = False,
    ) -> None:
        self.world_model = world_model
        self.rollouts = rollouts
        self.config = resolve_seconds(config, world_model.task.time_step)
        self.gamma = gamma
        self._step = compile_graph(_step, enabled=compile)

    @torch.no_grad()
    def __call__(
        self,
        actor: Layers,
        critics: Layers,
        state: Tensor,
        action: Tensor,
        generator: torch.Generator | None = None,
    ) -> Refit:
        """Fit copies of ``critics`` to the actor's returns.

        Args:
            actor: layers of the actor.
            critics: layers of the critics; they are not changed.
            state: states in which the returns start, ``[N, n]``.
            action: first actions ``[N, m]``; half of them are replaced by actions near the actor's.
            generator: source of randomness.
        """
        bounds, observation = self.rollouts.bounds, self.world_model.observe(state)
        action = self._mix(act(actor, observation, bounds), action, generator)
        value = q_values(critics, observation, action, bounds).mean(0)
        target, lag = self._targets(actor, critics, state, action, value)
        error_before = (value + lag - target).std().item()
        fitted = [layer.clone() for layer in critics]
        fitted[-1] += lag
        self._fit(fitted, observation, action, target, generator)
        error = q_values(fitted, observation, action, bounds).mean(0) - target
        return Refit(fitted, lag.item(), error_before, error.std().item())

    def _mix(self, own: Tensor, given: Tensor, generator: torch.Generator | None) -> Tensor:
        bounds = self.rollouts.bounds
        noise = torch.randn(own.shape, generator=generator, device=own.device)
        near = bounds.clip(own + _OWN_NOISE * bounds.scale * noise)
        draw = torch.rand(len(own), 1, generator=generator, device=own.device)
        return torch.where(draw < _OWN_SHARE, near, given)

    def _targets(
        self, actor: Layers, critics: Layers, state: Tensor, action: Tensor, value: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns ``[N]`` with the lag added, and the lag; non-finite returns become ``value``."""
        config, bounds, observe = self.config, self.rollouts.bounds, self.world_model.observe
        step = finite_transition(self.world_model.transition, state, action)
        state, reward, terminated = step
        returns = self.rollouts.returns(actor, state, config.horizon, self.gamma)
        observation = observe(returns.state)
        beyond = q_values(critics, observation, act(actor, observation, bounds), bounds).mean(0)
        alive = self.gamma * (1.0 - terminated.to(reward.dtype))
        weight = alive * returns.weight
        target = reward + alive * returns.total + weight * beyond
        finite = target.isfinite()
        target, weight = torch.where(finite, target, value), torch.where(finite, weight, 1.0)
        lag = (target - value).mean() / (1.0 - weight).mean().clamp_min(_SMALLEST_WEIGHT)
        return target + weight * lag, lag

    def _fit(
        self,
        critics: list[Tensor],
        observation: Tensor,
        action: Tensor,
        target: Tensor,
        generator: torch.Generator | None,
    ) -> None:
        config, bounds = self.config, self.rollouts.bounds
        means, squares = ([torch.zeros_like(layer) for layer in critics] for _ in range(2))
        counts = torch.arange(1, config.steps + 1, dtype=torch.float64, device=target.device)
        for i in range(config.steps):
            decay = 0.5 * (1.0 + math.cos(math.pi * i / config.steps))
            rates = adam_rates(counts[i], decay * config.learning_rate)
            index = torch.randint(
                len(target), (config.batch_size,), generator=generator, device=target.device
            )
            batch = observation[index], action[index], target[index]
            self._step(critics, means, squares, *batch, bounds, *rates)


def _step(
    critics: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    observation: Tensor,
    action: Tensor,
    target: Tensor,
    bounds: ActionBounds,
    size: Tensor,
    root: Tensor,
) -> None:
    """Take one step of Adam on the critics, in place."""
    gradients, _ = grad_and_value(critic_loss, critics, observation, action, target, bounds)
    adam_(critics, gradients, means, squares, size, root)
