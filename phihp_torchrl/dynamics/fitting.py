"""Fitting a model to transitions: by Adam, as published, or by least squares."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from phihp_torchrl.config import ConfigError, check_choice, check_count, check_positive
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.shooting import multiple_shooting


@dataclass(frozen=True)
class FitConfig:
    """How a model is fitted to transitions.

    Args:
        method: ``"levenberg_marquardt"``, ``"multiple_shooting"`` or ``"adam"``. The model is small
            and its loss is a sum of squares, so a second-order method reaches within seconds errors
            that Adam never reaches. Multiple shooting is for noisy sensors: it fits trajectories
            whose starts are free.
        steps: number of optimization steps.
        scaled: whether errors are measured in units of one-step changes
            (:meth:`DynamicsLoss.set_scales`), or in raw units as published.
        batch_size: transitions per step; ``None`` for all of them, as published.
        learning_rate: learning rate of Adam.
        cosine_decay: whether the learning rate of Adam decays to zero.
        initial_lambda: first value of λ for methods of least squares. A small one lets the prior
            explain as much as it can before the residual contributes.
        final_lambda: last value of λ for them.
        patience: they stop after this many steps at the final λ in which the held-out error did not
            fall by a tenth (multiple shooting: by a hundredth).
        window: steps in a trajectory of multiple shooting.
        shuffle_actions: whether the penalty on F^r of Levenberg-Marquardt pairs each state with the
            action of another transition. A controller's actions are correlated with the velocities, so
            that the smallest F^r on the pairs as recorded would explain friction by a wrong effect
            of the action.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> FitConfig(method="newton")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: method: expected one of ['levenberg_marquardt', \
'multiple_shooting', 'adam'], got 'newton'.
    """

    method: str = "levenberg_marquardt"
    steps: int = 60
    scaled: bool = True
    batch_size: int | None = 1000
    learning_rate: float = 1e-3
    cosine_decay: bool = False
    initial_lambda: float = 1e-2
    final_lambda: float = 1e7
    patience: int = 8
    window: int = 20
    shuffle_actions: bool = True

    def __post_init__(self) -> None:
        check_choice(self, "method", _METHODS)
        check_count(self, "steps", "patience", "window")
        check_positive(self, "learning_rate", "initial_lambda", "final_lambda")
        if self.batch_size is not None:
            check_count(self, "batch_size")


@dataclass(frozen=True)
class FitReport:
    """The result of a fit. Errors are the mean of ‖(s' - ŝ') / scale‖² over transitions.

    Args:
        train_error: error on the transitions that were fitted.
        held_out_error: error on the held-out transitions.
        steps: optimization steps that were taken.
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
    open_ = any(parameter.numel() for parameter in loss.dynamics.parameters())
    method = _METHODS[config.method]
    steps = method(loss, train, held_out, config, generator) if open_ else 0
    return FitReport(
        train_error=_error(loss, train),
        held_out_error=_error(loss, held_out),
        steps=steps,
        seconds=time.perf_counter() - start,
    )


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


@torch.no_grad()
def _levenberg_marquardt(
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
    system = _LeastSquares(loss)
    transitions = loss.transitions(train)
    penalised_action = transitions[1]
    if config.shuffle_actions:
        order = torch.randperm(len(penalised_action), generator=generator)
        penalised_action = penalised_action[order]
    reference, seconds = _timed(loss, held_out), loss.time_step(train)
    theta = system.parameters()
    damping = 1e-2
    growth = (config.final_lambda / config.initial_lambda) ** (1.0 / max(1, config.steps // 2))
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
        loss.lambda_.mul_(growth).clamp_(max=config.final_lambda)
    system.write(best)
    return steps


def _timed(loss: DynamicsLoss, data: TensorDictBase) -> tuple[Tensor, ...]:
    """The arguments of :meth:`DynamicsLoss.terms`, with time steps where the data have them."""
    transition, seconds = loss.transitions(data), loss.time_step(data)
    return transition if seconds is None else (*transition, transition[1], seconds)


_METHODS = {
    "levenberg_marquardt": _levenberg_marquardt,
    "multiple_shooting": multiple_shooting,
    "adam": _adam,
}


class _LeastSquares:
    """The residuals of the least-squares problem, and their Jacobian, by one parameter vector."""

    def __init__(self, loss: DynamicsLoss) -> None:
        self.loss = loss
        self.named = dict(loss.named_parameters())
        self.sizes = [p.numel() for p in self.named.values()]

    def parameters(self) -> Tensor:
        return torch.cat([p.detach().reshape(-1) for p in self.named.values()])

    def write(self, theta: Tensor) -> None:
        for name, value in self._unpack(theta).items():
            self.named[name].copy_(value)

    def _unpack(self, theta: Tensor) -> dict[str, Tensor]:
        parts = zip(self.named.items(), theta.split(self.sizes), strict=True)
        return {name: part.reshape(p.shape) for (name, p), part in parts}

    def _terms(self, theta: Tensor, *transition: Tensor) -> tuple[Tensor, Tensor]:
        parameters = {f"loss.{name}": value for name, value in self._unpack(theta).items()}
        return functional_call(_Terms(self.loss), parameters, transition)

    def _error(self, theta: Tensor, *transition: Tensor) -> Tensor:
        return self._terms(theta, *transition)[0]

    def _row(self, theta: Tensor, *transition: Tensor) -> Tensor:
        error, residual = self._terms(theta, *transition)
        return torch.cat([error, residual / self.loss.lambda_.sqrt()])

    def prediction_error(self, theta: Tensor, transitions: tuple[Tensor, ...]) -> float:
        return _each(self._error)(theta, *transitions).square().sum(-1).mean().item()

    def _rows(self, theta: Tensor, *rows: Tensor) -> Tensor:
        return _each(self._row)(theta, *rows)

    def step(
        self, theta: Tensor, rows: tuple[Tensor, ...], damping: float
    ) -> tuple[Tensor, float, bool]:
        """Take one damped step: new parameters, new damping, and whether the cost has fallen."""
        values = self._rows(theta, *rows).reshape(-1)
        jacobian = _each(jacrev(self._row))(theta, *rows).reshape(values.shape[0], -1)
        normal = (jacobian.mT @ jacobian).double()
        gradient = (jacobian.mT @ values).double()
        diagonal = normal.diagonal().clamp_min(1e-9 * normal.diagonal().max())
        cost = values.square().sum()
        for _ in range(8):
            delta, info = torch.linalg.solve_ex(normal + damping * diagonal.diag(), gradient)
            candidate = theta - delta.to(theta.dtype)
            if info == 0 and self._rows(candidate, *rows).square().sum() < cost:
                return candidate, max(damping / 5.0, 1e-10), True
            damping = min(damping * 4.0, 1e8)
        return theta, damping, False


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
