"""Model-predictive path integral control with a policy as a prior, as a function of tensors."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.planners.pool import BAD, Pool, fallback, score_pool, to_pool_layout
from phihp_torchrl.planners.scoring import Problem
from phihp_torchrl.planners.settings import MPPISettings


class MPPINoise(NamedTuple):
    """All randomness of a plan, drawn outside so that seeds reproduce."""

    samples: Tensor
    """Of the random candidates, standard normal, ``[I, H, N_rand, *batch, m]``."""
    policy: Tensor
    """On the actor's candidates, standard normal, ``[H, N_pi, *batch, m]``."""
    choice: Tensor
    """Of the elite to act with, uniform in [0, 1), ``[K, *batch]``."""


class MPPIPlan(NamedTuple):
    """What planning returns, each ``[*batch, H, m]`` but the score."""

    actions: Tensor
    """The sequence to act with, in bounds."""
    mean: Tensor
    """Mean of the last Gaussian, where the next plan may start from."""
    std: Tensor
    """Its std, in physical units; its first is the exploration noise of the publication."""
    score: Tensor
    """Of the best sequence of the last iteration, ``[*batch]``; -inf where none was finite."""


def mppi_plan(
    observation: Any,
    noise: MPPINoise,
    mean: Tensor | None,
    min_std: Tensor,
    *,
    problem: Problem,
    settings: MPPISettings,
) -> MPPIPlan:
    r"""Plan as TD-MPC does (Hansen et al., 2022, arXiv:2203.04955, section 3 and algorithm 1).

    In each iteration ``N_rand`` sequences from a Gaussian compete with ``N_pi`` of the actor. The
    ``K`` elites :math:`\Gamma_i` of score :math:`\phi_i` make the next Gaussian:

    .. math::
        \Omega_i = e^{\tau(\phi_i - \max_j \phi_j)}, \quad
        \mu \leftarrow \beta\mu + (1-\beta) \frac{\sum_i \Omega_i \Gamma_i}{\sum_i \Omega_i}, \quad
        \sigma \leftarrow \mathrm{clip}\Big(
        \sqrt{\tfrac{\sum_i \Omega_i (\Gamma_i - \hat\mu)^2}{\sum_i \Omega_i}},
        \sigma_{min}, \sigma_{init}\Big)

    with :math:`\hat\mu` the weighted mean, momentum :math:`\beta` and temperature :math:`\tau`. A
    score that is not finite never wins; where all are bad the actor's action is returned, or the
    mean without an actor. Nothing random happens in here and the rows of a batch do not meet.

    Args:
        observation: where to plan from, ``[*batch, o]``.
        noise: the randomness.
        mean: center of the first candidates, ``[*batch, H, m]``; ``None`` for the middle of the
            bounds.
        min_std: floor of the std, in units of the half-range, a scalar. It is an argument, so that
            a schedule compiles once.
        problem: model, bounds, actor and value.
        settings: the numbers; the horizon is that of the noise.
    """
    s, bounds = settings, problem.bounds
    horizon, action_dim = noise.samples.shape[1], noise.samples.shape[-1]
    batch = noise.samples.shape[3:-1]
    samples = noise.samples.flatten(3, -2) if batch else noise.samples.unsqueeze(3)
    rows = samples.shape[3]
    state = problem.model.locate(observation)
    state = state.reshape(-1, *state.shape[len(batch) :])

    center = bounds.center.expand(horizon, 1, rows, action_dim)
    center = center if mean is None else to_pool_layout(mean, rows)
    limits = (min_std * bounds.scale, s.init_std * bounds.scale)
    std = limits[1].expand(center.shape)

    guided = None
    if s.num_policy_candidates:
        policy_noise = noise.policy.reshape(horizon, -1, rows, action_dim)
        guided = _policy_candidates(state, policy_noise, problem, s)
    rescue = fallback(state, None if guided is None else guided.first(1), center, problem)
    for iteration_noise in samples.unbind(0):
        pool = score_pool(state, bounds.clip(center + std * iteration_noise), problem, s)
        if guided is not None:  # they bring their scores along, for the model is deterministic
            pool = Pool(
                torch.cat([guided.actions, pool.actions], 1),
                torch.cat([guided.scores, pool.scores], 0),
            )
        elites, _ = pool.best(s.top_k)
        weights = elite_weights(elites.scores, s.temperature)
        center, std = _refit(elites, weights, center, std, limits, s.momentum)

    if s.select == "sample":
        # The exponential race: the smallest of E_i / w_i, E_i exponential, is i with weight w_i.
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
    """Weights of elites ``[K, B]``, best first, that sum to one; equal where all are bad."""
    best, good = scores[:1], scores > BAD
    logits = torch.where(good, temperature * (scores - best), BAD)
    return torch.where(good[:1], logits, torch.zeros_like(logits)).softmax(0)


def _policy_candidates(state: Any, noise: Tensor, problem: Problem, settings: MPPISettings) -> Pool:
    """The actor's sequences, its own first; ``noise`` is ``[H, N_pi, B, m]``."""
    limit = settings.policy_noise_clip
    noise = (settings.policy_noise * noise).clamp(-limit, limit) * problem.bounds.scale
    noise = torch.cat([torch.zeros_like(noise[:, :1]), noise[:, 1:]], 1)
    return score_pool(state, torch.zeros_like(noise), problem, settings, noise)


def _refit(
    elites: Pool,
    weights: Tensor,
    center: Tensor,
    std: Tensor,
    limits: tuple[Tensor, Tensor],
    momentum: float,
) -> tuple[Tensor, Tensor]:
    """The next mean and std, ``[H, 1, B, m]``; where every elite is bad, all stays as it was."""
    good = (elites.scores > BAD)[None, ..., None]
    # A bad elite has no weight, but may hold no numbers either.
    actions = torch.where(good, elites.actions, torch.zeros_like(elites.actions))
    share = weights[None, ..., None]
    mean = (share * actions).sum(1, keepdim=True)
    variance = (share * (actions - mean).square()).sum(1, keepdim=True)
    new_std = variance.sqrt().clamp(*limits)
    new_center = momentum * center + (1.0 - momentum) * mean
    any_good = good[:, :1]
    return torch.where(any_good, new_center, center), torch.where(any_good, new_std, std)


def _to_batch(sequences: Tensor, batch: torch.Size) -> Tensor:
    """``[H, 1, B, m] -> [*batch, H, m]``."""
    sequences = sequences[:, 0].transpose(0, 1)
    return sequences.reshape(*batch, *sequences.shape[1:])
