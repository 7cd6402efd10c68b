"""Fits from other first weights, of which the best is kept: the loss of a fit has many minima."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.fitting import FitReport, fit
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.residual import ResidualMLP

# Fits with at most so many times the held-out error of the best describe the data as well: errors
# are squares, and there are few transitions by which they are compared.
_AS_WELL = 100.0


def fit_from_other_weights(
    loss: DynamicsLoss,
    report: FitReport,
    initial: Mapping[str, Tensor],
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator,
    *,
    restarts: int,
) -> tuple[FitReport, list[dict[str, Tensor]]]:
    """Fit a fitted model again from other first weights of its residual, and keep the best.

    A few hundred transitions leave the weights of a residual open where none of them lies, and a
    fit that goes on from an earlier one, to fewer transitions still, keeps what that one made up
    there. So the parameters with the smallest held-out error stay in ``loss.dynamics``. Others that
    describe the same data about as well, with a hundred times that error at most, show by what they
    predict differently what the data leave open.

    Args:
        loss: the loss of the fitted model, whose residual is a :class:`ResidualMLP`.
        report: what that fit reports.
        initial: the parameters of the model before its first fit; the weights of the residual among
            them are drawn anew.
        train: transitions ``[N]`` to learn from.
        held_out: transitions ``[M]`` by which the fits are compared.
        config: method and hyper-parameters of the fits.
        generator: source of first weights and mini-batches.
        restarts: number of further fits.

    Returns:
        What the fit that is kept reports, with the steps and seconds of all, and the parameters of
        those others, the better ones first.

    Raises:
        ValueError: as :func:`fit`.
        ConfigError: as :func:`fit`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> state, action = task.coverage.sample([64]), 4 * torch.rand(64, 1) - 2
        >>> truth = HybridDynamics.pure_prior(task, constants={"mass": 1.5})
        >>> following = TensorDict(observation=task.observe(truth(state, action)), batch_size=[64])
        >>> data = TensorDict(
        ...     observation=task.observe(state), action=action, next=following, batch_size=[64]
        ... ).detach()
        >>> model, config = HybridDynamics.hybrid(task), FitConfig(steps=5)
        >>> first, loss = model.state_dict(), DynamicsLoss(model)
        >>> first = {name: value.clone() for name, value in first.items()}
        >>> once = fit(loss, data, data, config)
        >>> best, others = fit_from_other_weights(
        ...     loss, once, first, data, data, config, torch.Generator(), restarts=2
        ... )
        >>> best.held_out_error <= once.held_out_error, len(others) <= 2
        (True, True)
    """
    model = loss.dynamics
    found = [(report, copy.deepcopy(model.state_dict()))]
    for _ in range(restarts):
        model.load_state_dict({**initial, **_other_weights(model.residual, generator)})
        again = fit(loss, train, held_out, config, generator)
        found.append((again, copy.deepcopy(model.state_dict())))
    found.sort(key=lambda each: each[0].held_out_error)
    (best, parameters), *others = found
    model.load_state_dict(parameters)
    whole = replace(
        best,
        steps=sum(each.steps for each, _ in found),
        seconds=sum(each.seconds for each, _ in found),
    )
    most = _AS_WELL * best.held_out_error
    return whole, [known for each, known in others if each.held_out_error <= most]


def _other_weights(residual: object, generator: torch.Generator) -> dict[str, Tensor]:
    """First weights of the residual by another draw, under their names in the model."""
    assert isinstance(residual, ResidualMLP)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        drawn = ResidualMLP.from_config(residual.system, residual.config)
    return {f"residual.{name}": value for name, value in drawn.named_parameters()}
