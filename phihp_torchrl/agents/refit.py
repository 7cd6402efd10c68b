"""Critics fitted to returns in the model, which TD3's own targets approach slowly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.agents.functional import (
    Layers,
    adam_,
    adam_rates,
    critic_loss,
    finite_transition,
    policy,
    q_values,
)
from phihp_torchrl.agents.imagination import Imagination
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.ranges import check_not_negative, check_positive

# Half of the actions are near the actor's, where actor and planner compare values; the others are
# those of the replay, so that the critics also know what not to do.
_OWN_SHARE = 0.5
_OWN_NOISE = 0.1
# Smallest mean of 1 - gamma^k by which a lag is told from the returns.
_SMALLEST_WEIGHT = 1e-2


@dataclass(frozen=True)
class RefitConfig:
    """When and how the critics are fitted to returns in the model.

    Args:
        start: critic updates before the first fit; 0 for the one at the end alone.
        interval: critic updates between two; 0 for none at all.
        transitions: how many actions have their return imagined.
        horizon: model steps of a return; the critics' own value comes after.
        steps: steps of Adam, with cosine decay.
        batch_size: transitions in a step.
        learning_rate: of Adam at first.
    """

    start: int = 0
    interval: int = 0
    transitions: int = 16384
    horizon: int = 100
    steps: int = 1500
    batch_size: int = 512
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        check_positive(self, "transitions", "horizon", "steps", "batch_size", "learning_rate")
        check_not_negative(self, "start", "interval")

    def is_due(self, updates: int, total: int) -> bool:
        """Whether the critics are fitted after ``updates`` of ``total`` updates."""
        if not self.interval:
            return False
        return updates >= total or (
            updates >= self.start > 0 and (updates - self.start) % self.interval == 0
        )


class Refit(NamedTuple):
    """What fitting the critics gave.

    Attributes:
        critics: the fitted layers.
        lag: by how much the values were too low on average.
        error_before: standard deviation of the values' error before, apart from the lag.
        error_after: the same after.
    """

    critics: list[Tensor]
    lag: float
    error_before: float
    error_after: float


class CriticRefit:
    r"""Policy evaluation by returns: the critics of an actor, fitted to what it earns in the model.

    .. math::
        y = \sum_{i<k} \gamma^i r_i + \gamma^k (\bar Q(s_k, \pi(s_k)) + c)

    The first action is given, the others are the actor's; :math:`\bar Q` is the mean of the critics
    before the fit. A TD target passes on :math:`\gamma` of a value and the targets follow slowly,
    so after a number of updates n the values as a whole still lack about
    :math:`e^{-\tau (1 - \gamma) n}` of themselves. That is the lag c, the one constant for which
    the critics agree with their returns on average; it takes no part in the fit. The model is the
    agent's own, so no real step is spent, and both critics learn the same target, without the
    minimum by which TD3 stays low.

    Args:
        world_model: the model.
        imagination: the same model, to imagine returns in.
        config: how.
        gamma: discount.
        compile: whether to compile a step of the fit.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents.td3 import TD3Config, TD3Update, make_td3_loss
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.oracle(task))
        >>> update = TD3Update(make_td3_loss(model, TD3Config()), model, TD3Config())
        >>> imagination = Imagination(model, torch.tensor(task.action_high), max_age=200)
        >>> refit = CriticRefit(model, imagination, RefitConfig(transitions=64, steps=2), 0.99)
        >>> state, action = task.coverage.sample([64]), torch.zeros(64, 1)
        >>> len(refit(update.actor, update.critics, state, action).critics)
        8
    """

    def __init__(
        self,
        world_model: TaskWorldModel,
        imagination: Imagination,
        config: RefitConfig,
        gamma: float,
        *,
        compile: bool = False,
    ) -> None:
        self.world_model = world_model
        self.imagination = imagination
        self.config = config
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
            critics: layers of the critics, which stay as they are.
            state: where to evaluate, ``[N, n]``.
            action: first actions ``[N, m]``; half of them give way to ones near the actor's.
            generator: source of randomness.
        """
        high, observation = self.imagination.action_high, self.world_model.observe(state)
        action = self._mix(policy(actor, observation, high), action, generator)
        value = q_values(critics, observation, action, high).mean(0)
        target, lag = self._targets(actor, critics, state, action, value)
        error_before = (value + lag - target).std().item()
        fitted = [layer.clone() for layer in critics]
        fitted[-1] += lag
        self._fit(fitted, observation, action, target, generator)
        error = q_values(fitted, observation, action, high).mean(0) - target
        return Refit(fitted, lag.item(), error_before, error.std().item())

    def _mix(self, own: Tensor, given: Tensor, generator: torch.Generator | None) -> Tensor:
        high = self.imagination.action_high
        noise = torch.randn(own.shape, generator=generator, device=high.device)
        near = torch.minimum(torch.maximum(own + _OWN_NOISE * high * noise, -high), high)
        draw = torch.rand(len(own), 1, generator=generator, device=high.device)
        return torch.where(draw < _OWN_SHARE, near, given)

    def _targets(
        self, actor: Layers, critics: Layers, state: Tensor, action: Tensor, value: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The returns ``[N]``, their lag added, and the lag; where one is not finite, ``value``."""
        config, high, observe = self.config, self.imagination.action_high, self.world_model.observe
        step = finite_transition(self.world_model.transition, state, action)
        state, reward, terminated = step
        returns = self.imagination.returns(actor, state, config.horizon, self.gamma)
        observation = observe(returns.state)
        beyond = q_values(critics, observation, policy(actor, observation, high), high).mean(0)
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
        config, high = self.config, self.imagination.action_high
        means, squares = ([torch.zeros_like(layer) for layer in critics] for _ in range(2))
        counts = torch.arange(1, config.steps + 1, dtype=torch.float64, device=high.device)
        for i in range(config.steps):
            decay = 0.5 * (1.0 + math.cos(math.pi * i / config.steps))
            rates = adam_rates(counts[i], decay * config.learning_rate)
            index = torch.randint(
                len(target), (config.batch_size,), generator=generator, device=high.device
            )
            batch = observation[index], action[index], target[index]
            self._step(critics, means, squares, *batch, high, *rates)


def _step(
    critics: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    observation: Tensor,
    action: Tensor,
    target: Tensor,
    action_high: Tensor,
    size: Tensor,
    root: Tensor,
) -> None:
    """One step of Adam on the critics."""
    gradients, _ = torch.func.grad_and_value(critic_loss)(
        critics, observation, action, target, action_high
    )
    adam_(critics, gradients, means, squares, size, root)
