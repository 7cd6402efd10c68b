"""Fitting a model to transitions: by Adam, as published, or by least squares."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics.ensemble import EnsembleResidual
from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.least_squares import levenberg_marquardt
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.members import member_loss
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.dynamics.shooting import multiple_shooting

DOING = "fitting the model"
"""What a run says that it is doing while this is on its stack."""


@dataclass(frozen=True)
class FitReport:
    """The result of a fit. Errors are the mean of ‖(s' - ŝ') / scale‖² over transitions.

    Args:
        train_error: error on the transitions that were fitted.
        held_out_error: error on the held-out transitions.
        steps: optimization steps that were taken, by all members of an ensemble together.
        seconds: duration of the fit.
    """

    train_error: float
    held_out_error: float
    steps: int
    seconds: float


def fit(
    loss: DynamicsLoss,
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator | None = None,
) -> FitReport:
    """Fit ``loss.dynamics`` to transitions in place, starting from its current parameters.

    The members of an :class:`EnsembleResidual` are fitted one after the other, each as if it were
    alone: the first with the prior to all of ``train``, the others without it to draws of as many
    transitions with replacement. The errors reported are those of their mean.

    Args:
        loss: the loss of the model; its λ and scales are changed as well.
        train: transitions ``[N]`` to learn from.
        held_out: transitions ``[M]`` on which the error is measured; methods of least squares keep
            the parameters with the smallest error on them.
        config: method and hyper-parameters of the fit.
        generator: source of mini-batches. Defaults to torch's global generator.

    Returns:
        Errors, number of steps and duration.

    Raises:
        ValueError: if there are no transitions, or some are not finite.
        ConfigError: for least squares with an integrator that chooses its own steps, which cannot
            be differentiated row by row.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> truth = HybridDynamics.pure_prior(task, constants={"mass": 1.5})
        >>> state, action = task.coverage.sample([64]), 4 * torch.rand(64, 1) - 2
        >>> following = TensorDict(observation=task.observe(truth(state, action)), batch_size=[64])
        >>> data = TensorDict(
        ...     observation=task.observe(state), action=action, next=following, batch_size=[64]
        ... ).detach()
        >>> loss = DynamicsLoss(HybridDynamics.pure_prior(task))
        >>> report = fit(loss, data, data, FitConfig(steps=20))
        >>> report.held_out_error < 1e-6
        True
    """
    for name, data in (("train", train), ("held_out", held_out)):
        if data.batch_size.numel() == 0:  # numel of a tensordict is never below 1
            raise ValueError(f"{name}: expected at least one transition, got none.")
        # Check the observations, because atan2 makes a finite angle of infinite cosines and sines.
        if not all(data.get(key).isfinite().all() for key in loss.in_keys):
            raise ValueError(f"{name}: expected finite transitions, got some that are not.")
    if config.method != "adam" and not loss.dynamics.integrator.compiles:
        raise ConfigError(
            "method",
            "expected 'adam' for a model that is integrated by "
            f"{type(loss.dynamics.integrator).__name__}, got {config.method!r}.",
        )
    start = time.perf_counter()
    if config.scaled:
        loss.set_scales(train)
    # A prior whose constants are all fixed has nothing to fit.
    if not any(parameter.numel() for parameter in loss.dynamics.parameters()):
        steps = 0
    elif isinstance(loss.dynamics.residual, EnsembleResidual):
        steps = _fit_members(loss, loss.dynamics.residual, train, held_out, config, generator)
    else:
        steps = _METHODS[config.method](loss, train, held_out, config, generator)
    return FitReport(
        train_error=_error(loss, train),
        held_out_error=_error(loss, held_out),
        steps=steps,
        seconds=time.perf_counter() - start,
    )


def _fit_members(
    loss: DynamicsLoss,
    ensemble: EnsembleResidual,
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator | None,
) -> int:
    method = _METHODS[config.method]
    steps, count = 0, len(train)
    for index in range(ensemble.members):
        own = member_loss(loss, index)
        drawn = train
        if index > 0:
            drawn = train[torch.randint(count, (count,), generator=generator)]
        steps += method(own, drawn, held_out, config, generator)
        fitted = own.dynamics.residual
        assert isinstance(fitted, ResidualMLP)
        ensemble.set_member(index, fitted)
    with torch.no_grad():
        loss.lambda_.copy_(own.lambda_)  # every member's has grown alike
    return steps


@torch.no_grad()
def _error(loss: DynamicsLoss, data: TensorDictBase) -> float:
    return loss(data)["loss_prediction"].item()


def _adam(
    loss: DynamicsLoss,
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator | None,
) -> int:
    optimizer = torch.optim.Adam(loss.dynamics.parameters(), lr=config.learning_rate, fused=True)
    for step in range(config.steps):
        if config.cosine_decay:
            decay = 0.5 * (1.0 + math.cos(math.pi * step / config.steps))
            optimizer.param_groups[0]["lr"] = config.learning_rate * decay
        batch = train
        if config.batch_size is not None and config.batch_size < len(train):
            batch = train[torch.randint(len(train), (config.batch_size,), generator=generator)]
        losses = loss(batch)
        (losses["loss_prediction"] + losses["loss_residual"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        loss.update_lambda(losses["loss_prediction"].detach())
    return config.steps


_METHODS = {
    "levenberg_marquardt": levenberg_marquardt,
    "multiple_shooting": multiple_shooting,
    "adam": _adam,
}
