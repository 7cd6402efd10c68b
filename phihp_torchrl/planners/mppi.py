"""Model-predictive path integral control guided by a policy: settings, and a pure plan function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, Steps, check_choice, check_not_negative
from phihp_torchrl.planners.candidates import BAD, Pool, fallback, score_pool, to_pool_layout
from phihp_torchrl.planners.problem import Problem
from phihp_torchrl.planners.search import SearchConfig


@dataclass(frozen=True)
class MPPIConfig(SearchConfig):
    """Settings of an :class:`~phihp_torchrl.MPPIPlanner` (Hansen et al., 2022, section 3).

    In every iteration the candidates are the actor's ``num_policy_candidates`` sequences and
    ``num_candidates - num_policy_candidates`` new ones.

    Args:
        min_std: lower limit of the refitted std, in units of the action's half-range.
        temperature: factor on the score in the weight of an elite, exp(temperature * score).
        momentum: share of the previous mean in the new mean.
        select: whether to act with an elite drawn by its weight (sample) or with the mean (mean).

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> MPPIConfig(momentum=1.0)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: momentum: expected a number in [0, 1), got 1.0.
    """

    kind: ClassVar[str] = "mppi"

    planning_horizon: Steps = 5
    optim_steps: int = 4
    num_candidates: int = 134
    top_k: int = 16
    num_policy_candidates: int = 6
    policy_noise: float = 0.05
    policy_noise_clip: float = 0.3
    init_std: float = 2.0
    min_std: float = 0.05
    temperature: float = 0.5
    momentum: float = 0.1
    select: str = "sample"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_policy_candidates == self.num_candidates:
            raise ConfigError(
                "num_policy_candidates",
                f"expected fewer than num_candidates = {self.num_candidates}, "
                f"got {self.num_policy_candidates}.",
            )
        if self.min_std > self.init_std:
            raise ConfigError(
                "min_std", f"expected at most init_std = {self.init_std}, got {self.min_std}."
            )
        check_not_negative(self, "temperature")
        if not 0 <= self.momentum < 1:
            raise ConfigError("momentum", f"expected a number in [0, 1), got {self.momentum!r}.")
        check_choice(self, "select", ("sample", "mean"))


class MPPINoise(NamedTuple):
    """All random numbers of a plan, drawn outside the compiled function so that seeds reproduce."""

    samples: Tensor
    """Noise of the random candidates, standard normal, ``[I, H, N_rand, *batch, m]``."""
    policy: Tensor
    """Noise on the actor's candidates, standard normal, ``[H, N_pi, *batch, m]``."""
    choice: Tensor
    """Random numbers that choose the elite to act with, uniform in [0, 1), ``[K, *batch]``."""


class MPPIPlan(NamedTuple):
    """The result of planning with MPPI; all but the score are ``[*batch, H, m]``."""

    actions: Tensor
    """The chosen action sequence, in bounds."""
    mean: Tensor
    """Mean of the last Gaussian, from which the next plan can start."""
    std: Tensor
    """Std of the last Gaussian, in physical units; that of the first action is for exploration."""
    score: Tensor
    """Score of the best candidate of the last iteration, ``[*batch]``; -inf if none is finite."""


def mppi_plan(
    observation: Any,
    noise: MPPINoise,
    mean: Tensor | None,
    min_std: Tensor,
    last: Tensor | None = None,
    *,
    problem: Problem,
    settings: MPPIConfig,
) -> MPPIPlan:
    r"""Plan as TD-MPC does (Hansen et al., 2022, arXiv:2203.04955, section 3 and algorithm 1).

    The candidates of an iteration are ``N_rand`` sequences from a Gaussian and ``N_pi`` of the
    actor. The ``K`` elites :math:`\Gamma_i` of score :math:`\phi_i` define the next Gaussian:

    .. math::
        \Omega_i = e^{\tau(\phi_i - \max_j \phi_j)}, \quad
        \mu \leftarrow \beta\mu + (1-\beta) \frac{\sum_i \Omega_i \Gamma_i}{\sum_i \Omega_i}, \quad
        \sigma \leftarrow \mathrm{clip}\Big(
        \sqrt{\tfrac{\sum_i \Omega_i (\Gamma_i - \hat\mu)^2}{\sum_i \Omega_i}},
        \sigma_{min}, \sigma_{init}\Big)

    with :math:`\hat\mu` the weighted mean, momentum :math:`\beta` and temperature :math:`\tau`. A
    candidate whose score is not finite is never chosen; if no score is finite, the result is the
    actor's sequence, or the mean without an actor. The function draws no random numbers, and the
    rows of a batch are independent.

    Args:
        observation: observations to plan from, ``[*batch, o]``.
        noise: random numbers of the plan; their shape sets the horizon.
        mean: center of the first candidates, ``[*batch, H, m]``; ``None`` for the middle of the
            bounds.
        min_std: lower limit of the std, in units of the half-range, a scalar. It is a separate
            argument so that a schedule needs to compile only once.
        last: the action before, ``[*batch, m]``, for the price of a change; NaN where there is
            none.
        problem: model, bounds, actor and value.
        settings: settings of the search.

    Returns:
        The chosen action sequence, the last Gaussian and the score.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> problem = Problem(TaskWorldModel(task, HybridDynamics.hybrid(task)), task.bounds)
        >>> settings = MPPIConfig(num_candidates=16, top_k=4, num_policy_candidates=0)
        >>> noise = MPPINoise(
        ...     samples=torch.randn(4, 5, 16, 3, 1),
        ...     policy=torch.zeros(5, 0, 3, 1),
        ...     choice=torch.rand(4, 3),
        ... )
        >>> observation, min_std = task.observe(torch.zeros(3, 2)), torch.tensor(0.05)
        >>> plan = mppi_plan(observation, noise, None, min_std, problem=problem, settings=settings)
        >>> plan.actions.shape, bool((plan.std >= 0.1).all())  # the half-range is 2 N·m
        (torch.Size([3, 5, 1]), True)
    """
    s, bounds = settings, problem.bounds
    horizon, action_dim = noise.samples.shape[1], noise.samples.shape[-1]
    batch = noise.samples.shape[3:-1]
    rows = batch.numel()
    samples = noise.samples.reshape(*noise.samples.shape[:3], rows, action_dim)
    state = problem.model.locate(observation)
    state = state.reshape(rows, *state.shape[len(batch) :])

    last = None if last is None else last.reshape(rows, action_dim)
    center = bounds.center.expand(horizon, 1, rows, action_dim)
    center = center if mean is None else to_pool_layout(mean, rows)
    limits = (min_std * bounds.scale, s.init_std * bounds.scale)
    std = limits[1].expand(center.shape)

    guided = None
    if s.num_policy_candidates:
        policy_noise = noise.policy.reshape(horizon, s.num_policy_candidates, rows, action_dim)
        guided = _policy_candidates(state, policy_noise, last, problem, s)
    rescue = fallback(state, None if guided is None else guided.first(1), center, problem)
    for iteration_noise in samples.unbind(0):
        sampled = bounds.clip(center + std * iteration_noise)
        pool = score_pool(state, sampled, problem, s, last=last)
        if guided is not None:  # their scores are known, since the model is deterministic
            pool = Pool(
                torch.cat([guided.actions, pool.actions], 1),
                torch.cat([guided.scores, pool.scores], 0),
            )
        elites, _ = pool.best(s.top_k)
        weights = elite_weights(elites.scores, s.temperature)
        center, std = _refit(elites, weights, center, std, limits, s.momentum)

    if s.select == "sample":
        # With E_i exponential, the smallest of E_i / w_i is that of i with probability w_i.
        exponential = -torch.log1p(-noise.choice.reshape(s.top_k, rows))
        race = exponential.clamp_min(torch.finfo(weights.dtype).tiny) / weights
        index = race.argmin(0)[None, None, :, None].expand(horizon, 1, rows, action_dim)
        actions = elites.actions.gather(1, index)
    else:
        actions = bounds.clip(center)
    score = elites.scores[0]
    actions = torch.where((score > BAD)[None, None, :, None], actions, rescue)
    return MPPIPlan(
        actions=_to_batch(actions, batch),
        mean=_to_batch(center, batch),
        std=_to_batch(std, batch),
        score=score.reshape(batch),
    )


def elite_weights(scores: Tensor, temperature: float) -> Tensor:
    """Return weights of elites ``[K, B]``, which sum to one; equal if no score is finite."""
    best, good = scores[:1], scores > BAD
    logits = torch.where(good, temperature * (scores - best), BAD)
    return torch.where(good[:1], logits, torch.zeros_like(logits)).softmax(0)


def _policy_candidates(
    state: Any, noise: Tensor, last: Tensor | None, problem: Problem, settings: MPPIConfig
) -> Pool:
    """Score the actor's sequences, the noise-free one first; ``noise`` is ``[H, N_pi, B, m]``."""
    limit = settings.policy_noise_clip
    noise = (settings.policy_noise * noise).clamp(-limit, limit) * problem.bounds.scale
    noise = torch.cat([torch.zeros_like(noise[:, :1]), noise[:, 1:]], 1)
    return score_pool(state, torch.zeros_like(noise), problem, settings, noise, last)


def _refit(
    elites: Pool,
    weights: Tensor,
    center: Tensor,
    std: Tensor,
    limits: tuple[Tensor, Tensor],
    momentum: float,
) -> tuple[Tensor, Tensor]:
    """Return the next mean and std, ``[H, 1, B, m]``; unchanged if no elite has a finite score."""
    good = (elites.scores > BAD)[None, ..., None]
    # An elite without a finite score has no weight, but its actions may be non-finite.
    actions = torch.where(good, elites.actions, torch.zeros_like(elites.actions))
    share = weights[None, ..., None]
    mean = (share * actions).sum(1, keepdim=True)
    variance = (share * (actions - mean).square()).sum(1, keepdim=True)
    new_std = variance.sqrt().clamp(*limits)
    new_center = momentum * center + (1.0 - momentum) * mean
    any_good = good[:, :1]
    return torch.where(any_good, new_center, center), torch.where(any_good, new_std, std)


def _to_batch(sequences: Tensor, batch: torch.Size) -> Tensor:
    """Rearrange sequences from ``[H, 1, B, m]`` to ``[*batch, H, m]``."""
    sequences = sequences[:, 0].transpose(0, 1)
    return sequences.reshape(*batch, *sequences.shape[1:])
