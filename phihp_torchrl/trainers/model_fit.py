"""One fit of phase 1: the choice of the integrator, and what is measured of the model."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.dynamics import (
    AUTO,
    BLOCK,
    SOLVERS,
    DynamicsLoss,
    FitConfig,
    FitReport,
    PhysicsPrior,
    ResidualMLP,
    fit_from_other_weights,
    fit_solver,
    rollout_error,
)
from phihp_torchrl.trainers.model_config import ModelConfig

_log = logging.getLogger(__name__)

# Held-out error, a mean of squares in units of one-step changes, below which no fit is better in a
# way that a plan would notice.
_EXACT = 1e-8
# Where it is at most so many times the error on the fitted transitions, these pin the model down.
_PINNED = 2.0


def chooses_solver(config: ModelConfig) -> bool:
    """Whether the first and the last fit choose the integrator; Adam is too slow for trials."""
    return config.integrator == AUTO and config.fit.method != "adam"


def fit_choosing(
    loss: DynamicsLoss,
    train: TensorDict,
    held_out: TensorDict,
    config: FitConfig,
    generator: torch.Generator,
) -> FitReport:
    """Fit, choose the integrator by held-out error, and say which.

    Args:
        loss: the loss of the model, which then has the chosen integrator.
        train: transitions to fit.
        held_out: transitions for the choice.
        config: how to fit.
        generator: source of mini-batches.
    """
    report, trials = fit_solver(loss, train, held_out, config, generator)
    if len(trials) > 1:
        tried = ", ".join(str(trial) for trial in trials)
        solver = loss.dynamics.integrator
        _log.info("The model is integrated by %s (held-out errors: %s).", solver, tried)
    return report


def fit_again(
    loss: DynamicsLoss,
    report: FitReport,
    initial: Mapping[str, Tensor],
    train: TensorDict,
    held_out: TensorDict,
    config: ModelConfig,
    generator: torch.Generator,
) -> tuple[FitReport, list[dict[str, Tensor]]]:
    """Fit from other first weights too, where the settings say so and the data leave much open.

    Args:
        loss: the loss of the fitted model.
        report: what its fit reports.
        initial: the parameters before the first fit.
        train: transitions to fit.
        held_out: transitions by which fits are compared.
        config: settings of the phase.
        generator: source of first weights and mini-batches.

    Returns:
        As :func:`~phihp_torchrl.dynamics.fit_from_other_weights`.
    """
    single = type(loss.dynamics.residual) is ResidualMLP
    quick = config.fit.method != "adam"
    known = max(_EXACT, _PINNED * report.train_error)
    if not (config.restarts and single and quick) or report.held_out_error <= known:
        return report, []
    found, others = fit_from_other_weights(
        loss,
        report,
        initial,
        train,
        held_out,
        config.fit,
        generator,
        restarts=config.restarts,
    )
    if found.held_out_error < report.held_out_error:
        _log.info(
            "A fit from other first weights is kept, with a held-out error of %.2g; the first fit "
            "has %.2g.",
            found.held_out_error,
            report.held_out_error,
        )
    return found, others


def solver_number(loss: DynamicsLoss) -> int | None:
    """The number of the model's integrator among those that are tried, for checkpoints."""
    return next((i for i, s in enumerate(SOLVERS) if s is loss.dynamics.integrator), None)


def measures(
    loss: DynamicsLoss, report: FitReport, train: TensorDict, blocks: TensorDict | None
) -> dict[str, Tensor | float]:
    """What is logged of a fitted model.

    Args:
        loss: the loss of the model.
        report: what the fit reports.
        train: the fitted transitions.
        blocks: held-out transitions in a row, for the error of rollouts; ``None`` for none.
    """
    dynamics = loss.dynamics
    state, action, _ = loss.transitions(train)
    found: dict[str, Tensor | float] = {
        "model/train_error": report.train_error,
        "model/held_out_error": report.held_out_error,
        "model/fit_steps": report.steps,
        "model/fit_seconds": report.seconds,
        "model/lambda": loss.lambda_,
        "model/residual_share": dynamics.residual_share(state, action),
    }
    if blocks is not None:
        found[f"model/rollout_error_{BLOCK}"] = rollout_error(loss, blocks)
    if isinstance(dynamics.prior, PhysicsPrior):
        constants = dynamics.prior.constants()
        for name, value in dynamics.task.system.identifiable(constants).items():
            found[f"constants/{name}"] = value.detach()
    return found
