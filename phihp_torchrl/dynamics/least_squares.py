"""Levenberg-Marquardt: the loss of a model as a sum of squares of its transitions."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.parameters import ParameterVector
from phihp_torchrl.dynamics.robust import huber_loss, huber_weight, robust_spread


@torch.no_grad()
def levenberg_marquardt(
    loss: DynamicsLoss,
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator | None,
) -> int:
    r"""Minimise mean ‖error‖² + (1/lambda) mean ‖F^r‖² by damped Gauss-Newton steps.

    .. math:: (J^\top J + \mu\,\mathrm{diag}\,J^\top J)\,\delta = -J^\top r

    The penalty is a square, unlike the norm in the paper's equation 3, because the method needs
    squares; and F^r is penalised at shuffled actions if ``config.shuffle_actions`` is set.
    """
    system = LeastSquares(loss, config.robust)
    transitions = loss.transitions(train)
    penalised_action = transitions[1]
    if config.shuffle_actions:
        order = torch.randperm(len(penalised_action), generator=generator)
        penalised_action = penalised_action[order]
    reference, seconds = _timed(loss, held_out), loss.time_step(train)
    theta = system.vector.read()
    damping = 1e-2
    loss.lambda_.fill_(config.initial_lambda)
    # The first parameters are a candidate too, because they may come from an earlier, better fit.
    best, best_error = theta, system.prediction_error(theta, reference)
    if not math.isfinite(best_error):
        best_error = math.inf
    stale, steps = 0, 0
    while steps < config.steps:
        steps += 1
        rows: tuple[Tensor, ...] = (*transitions, penalised_action)
        rows += () if seconds is None else (seconds,)
        if config.batch_size is not None and config.batch_size < len(train):
            index = torch.randint(len(train), (config.batch_size,), generator=generator)
            rows = tuple(part[index] for part in rows)
        theta, damping, improved = system.step(theta, rows, damping)
        error = system.prediction_error(theta, reference)
        stale = 0 if error < 0.9 * best_error else stale + 1
        if error < best_error:
            best, best_error = theta, error
        final = loss.lambda_.item() >= config.final_lambda
        if final and (stale >= config.patience or not improved):
            break
        loss.lambda_.mul_(config.lambda_growth).clamp_(max=config.final_lambda)
    system.vector.write(best)
    return steps


def _timed(loss: DynamicsLoss, data: TensorDictBase) -> tuple[Tensor, ...]:
    """The arguments of :meth:`DynamicsLoss.terms`, with time steps where the data have them."""
    transition, seconds = loss.transitions(data), loss.time_step(data)
    return transition if seconds is None else (*transition, transition[1], seconds)


class LeastSquares:
    """The residuals of the least-squares problem, and their Jacobian, by one parameter vector."""

    def __init__(self, loss: DynamicsLoss, robust: float | None = None) -> None:
        self.loss, self.robust = loss, robust
        self.vector = ParameterVector(loss)

    def _terms(self, theta: Tensor, *transition: Tensor) -> tuple[Tensor, Tensor]:
        parameters = self.vector.unpack(theta, "loss.")
        return functional_call(_Terms(self.loss), parameters, transition)

    def error(self, theta: Tensor, *transition: Tensor) -> Tensor:
        return self._terms(theta, *transition)[0]

    def row(self, theta: Tensor, *transition: Tensor) -> Tensor:
        error, residual = self._terms(theta, *transition)
        return torch.cat([error, residual / self.loss.lambda_.sqrt()])

    def prediction_error(self, theta: Tensor, transitions: tuple[Tensor, ...]) -> float:
        errors = _each(self.error)(theta, *transitions)
        if self.robust is not None:
            bend = self.robust * robust_spread(errors)
            return huber_loss(errors, bend).sum(-1).mean().item()
        return errors.square().sum(-1).mean().item()

    def _rows(self, theta: Tensor, *rows: Tensor) -> Tensor:
        return _each(self.row)(theta, *rows)

    def step(
        self, theta: Tensor, rows: tuple[Tensor, ...], damping: float
    ) -> tuple[Tensor, float, bool]:
        """Take one damped step: new parameters, new damping, and whether the cost has fallen."""
        values = self._rows(theta, *rows)
        jacobian = _each(jacrev(self.row))(theta, *rows).reshape(values.numel(), -1)
        bend = self._bend(values)
        cost = self._cost(values, bend)
        if bend is not None:
            weight = huber_weight(values, bend).sqrt()
            values, jacobian = weight * values, weight.reshape(-1, 1) * jacobian
        values = values.reshape(-1)
        normal = (jacobian.mT @ jacobian).double()
        gradient = (jacobian.mT @ values).double()
        diagonal = normal.diagonal().clamp_min(1e-9 * normal.diagonal().max())
        for _ in range(8):
            delta, info = torch.linalg.solve_ex(normal + damping * diagonal.diag(), gradient)
            candidate = theta - delta.to(theta.dtype)
            if info == 0 and self._cost(self._rows(candidate, *rows), bend) < cost:
                return candidate, max(damping / 5.0, 1e-10), True
            damping = min(damping * 4.0, 1e8)
        return theta, damping, False

    def _bend(self, values: Tensor) -> Tensor | None:
        """Where squares end, for errors and penalties ``[N, 2n]``; penalties stay squares."""
        if self.robust is None:
            return None
        errors, penalties = values.chunk(2, -1)
        bend = self.robust * robust_spread(errors)
        return torch.cat([bend, torch.full_like(penalties[0], math.inf)])

    @staticmethod
    def _cost(values: Tensor, bend: Tensor | None) -> Tensor:
        return (values.square() if bend is None else huber_loss(values, bend)).reshape(-1).sum()


def _each(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Map a function of parameters and one transition over all transitions."""

    def mapped(theta: Tensor, *rows: Tensor) -> Tensor:
        return vmap(function, (None, *[0] * len(rows)))(theta, *rows)

    return mapped


class _Terms(torch.nn.Module):
    """:meth:`DynamicsLoss.terms` as a forward pass."""

    def __init__(self, loss: DynamicsLoss) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, *transition: Tensor) -> tuple[Tensor, Tensor]:
        return self.loss.terms(*transition)
