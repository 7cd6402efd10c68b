"""The choice of a model's integrator by its held-out error."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase

from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.fitting import FitReport, fit
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.shooting import cut_windows
from phihp_torchrl.integrators import RK4, Integrator, SemiImplicitEuler

AUTO = "auto"
"""The name in settings of a choice by held-out error."""

SOLVERS: tuple[Integrator, ...] = (
    SemiImplicitEuler(),
    SemiImplicitEuler(substeps=2),
    RK4(),
    SemiImplicitEuler(substeps=4),
    RK4(substeps=2),
)
"""What is tried, by evaluations of ds/dt in a step: 1, 2, 4, 4 and 8."""

_WORTH = 2.0
"""A solver must divide the error of held-out paths by this to be preferred to a cheaper one."""

_STEPS = 20
"""Steps of the paths by which solvers are compared."""

_GOOD = 1e-5
"""A held-out error at which the cheapest solver is not questioned: 0.3 % of a step's change."""

_TRIAL_STEPS = 15
"""Optimization steps of a trial; the fit with the chosen solver takes all."""


@dataclass(frozen=True)
class SolverTrial:
    """A fit with one solver.

    Args:
        integrator: the solver.
        report: what the fit gave.
        error: mean squared error of held-out paths, in steps, of the median path.
    """

    integrator: Integrator
    report: FitReport
    error: float

    def __str__(self) -> str:
        return f"{self.integrator} {self.error:.3g}"


def fit_solver(
    loss: DynamicsLoss,
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator | None = None,
    *,
    solvers: Sequence[Integrator] = SOLVERS,
) -> tuple[FitReport, list[SolverTrial]]:
    """Fit the model, with the cheapest solver that predicts about as well as any.

    Imagination and planning pay for each evaluation of ds/dt, so a finer solver must at least halve
    the error of the cheaper one, on held-out paths: what a solver leaves out adds up over steps,
    while noise in a single one hides it. Where the cheapest is good enough, no other is tried.
    Every fit starts from the same parameters and draws the same numbers, so the result is that of
    :func:`fit` with the chosen solver.

    Args:
        loss: the loss of the model, whose integrator is replaced.
        train: transitions ``[N]`` to learn from.
        held_out: transitions ``[M]`` by which the solvers are compared.
        config: method and hyper-parameters of the fits.
        generator: source of mini-batches. Defaults to torch's global generator.
        solvers: the solvers, the cheapest first.

    Returns:
        What the fit with the chosen solver gave, and the trials in order.

    Raises:
        ValueError: as :func:`fit`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> truth = HybridDynamics.pure_prior(task, integrator="rk4")
        >>> state, action = task.coverage.sample([64]), 4 * torch.rand(64, 1) - 2
        >>> following = TensorDict(observation=task.observe(truth(state, action)), batch_size=[64])
        >>> data = TensorDict(
        ...     observation=task.observe(state), action=action, next=following, batch_size=[64]
        ... ).detach()
        >>> loss = DynamicsLoss(HybridDynamics.pure_prior(task))
        >>> report, trials = fit_solver(loss, data, data, FitConfig(steps=20))
        >>> loss.dynamics.integrator.name
        'rk4'
    """
    start, draws = copy.deepcopy(loss.state_dict()), draws_of(generator)

    def fit_with(solver: Integrator, config: FitConfig) -> FitReport:
        loss.load_state_dict(start)
        set_draws(generator, draws)
        loss.dynamics.integrator = solver
        return fit(loss, train, held_out, config, generator)

    # Multiple shooting has no use for a solver that one-step errors, which are cheaper, rule out.
    plain = replace(config, method="levenberg_marquardt")
    report = fit_with(solvers[0], plain)
    if report.held_out_error <= _GOOD or len(solvers) == 1:
        trials = [SolverTrial(solvers[0], report, path_error(loss, held_out))]
        return (report if config == plain else fit_with(solvers[0], config)), trials
    short = replace(plain, steps=min(config.steps, _TRIAL_STEPS))
    trials = [
        SolverTrial(solver, fit_with(solver, short), path_error(loss, held_out))
        for solver in solvers
    ]
    return fit_with(trials[choose(trials)].integrator, config), trials


def choose(trials: Sequence[SolverTrial]) -> int:
    """Return the index of the cheapest trial whose error no finer one divides by :data:`_WORTH`."""
    errors = [trial.error for trial in trials]
    good = [i for i, error in enumerate(errors) if error <= _WORTH * min(errors)]
    return good[0]


@torch.no_grad()
def path_error(loss: DynamicsLoss, data: TensorDictBase) -> float:
    """Mean squared error in steps of the median path of up to 20 steps from a measured state."""
    windows = cut_windows(loss, data, _STEPS)
    state, errors = windows.states[:, 0], []
    for k, (action, seconds) in enumerate(
        zip(windows.actions.unbind(1), windows.seconds.unbind(1), strict=True), start=1
    ):
        state = loss.dynamics.step(state, action, seconds)
        error = loss.dynamics.task.difference(windows.states[:, k], state) / loss.error_scale
        errors.append(error.square().sum(-1).nan_to_num(math.inf))
    known = windows.known[:, 1:]
    total = torch.where(known, torch.stack(errors, 1), 0.0).sum(1) / known.sum(1)
    return total.median().item()


def draws_of(generator: torch.Generator | None) -> torch.Tensor:
    """The state of a generator, or of torch's global one, from which the same numbers follow."""
    return torch.get_rng_state() if generator is None else generator.get_state()


def set_draws(generator: torch.Generator | None, state: torch.Tensor) -> None:
    """Go back to a state of :func:`draws_of`."""
    if generator is None:
        torch.set_rng_state(state)
    else:
        generator.set_state(state)
