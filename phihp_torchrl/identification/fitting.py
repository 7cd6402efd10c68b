"""The fit itself: choices by trials, whether stops are there, and then all windows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.dynamics import PhysicsPrior
from phihp_torchrl.identification.choices import Chooser, given_path
from phihp_torchrl.identification.config import AUTO, IdentifyConfig
from phihp_torchrl.identification.division import LEAST, TRIAL, Division, divide, spread
from phihp_torchrl.identification.held_out import Span
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.parts import ActuatorTrial, Estimate
from phihp_torchrl.identification.restitution import fit_restitution
from phihp_torchrl.identification.settling import settle
from phihp_torchrl.identification.shooting import Fit, Shooting
from phihp_torchrl.identification.stops import check_stops, suspect_stops
from phihp_torchrl.identification.trials import WINDOWS, Trials
from phihp_torchrl.identification.windows import (
    Samples,
    Windows,
    cut,
    first_starts,
    make_windows,
    runs,
)
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task

_OUTLYING = 10.0
"""How much larger than usual the mean squared residual of a window is that is left out."""
_FAILS = 3.0
"""How much larger than usual the loss at a suspected stop is, if it is one."""


class Fitted(NamedTuple):
    """A model that fits, and what it was fitted to.

    Args:
        model: the equations behind the chosen actuator.
        stopping: the same with stops, for predictions that meet them.
        judged: their parameters, fitted without what is held out; errors are theirs.
        fit: their parameters, fitted to everything; constants are theirs.
        windows: what was fitted in the end.
        outlying: windows that were left out because the equations do not describe them.
        division: which samples were held out and left out.
        found: names of the positions whose stops were found in the data.
        restitution: how positions leave their stops, by name.
        tried: the paths of the command that were tried.
    """

    model: Model
    stopping: Model
    judged: Fit
    fit: Fit
    windows: Windows
    outlying: int
    division: Division
    found: tuple[str, ...]
    restitution: dict[str, Estimate]
    tried: tuple[ActuatorTrial, ...]


def fit_recordings(task: Task, samples: Samples, config: IdentifyConfig) -> Fitted:
    """Choose the path of the command and the integrator, and fit all windows.

    That is done twice: without the held-out samples, whose predictions tell the errors, and then,
    from there, with them, for the best constants that the recordings can give.

    Args:
        task: the system, and stops that are known.
        samples: the recordings.
        config: how.
    """
    system = task.system
    known = {**task.position_limits, **config.stops}
    given = check_stops(system, known)
    found = {n: pair for n, pair in suspect_stops(system, samples).items() if n not in given}
    division = divide(system, samples, {**given, **found}, config)
    chooser = _choose(task, samples, division, config)
    if found and not _stops_matter(chooser, samples, division):
        found = {}
        division = divide(system, samples, given, config)
        chooser = _choose(task, samples, division, config)
    model = chooser.settled()
    sigma = chooser.trials.noise(chooser.best)
    judged = _fit_all(model, samples, division.spans, config, chooser.best.raw, sigma)
    final = judged
    if division.held:
        spans = cut(division.inside, division.window, LEAST)
        final = _fit_all(model, samples, spans, config, judged.fit.raw, judged.fit.sigma)
    limits = {name: pair for name, pair in division.stops.items() if name in system.velocity_of}
    layout = system.layout(task.velocity_limits, limits, task.restitution)
    stopping = model.stopping(layout, judged.fit.raw)
    bounces = fit_restitution(model, stopping, samples, judged.fit, limits)
    kept = [bounces[n].estimate if n in bounces else r for n, r in _by_name(system, stopping)]
    stopping = replace(stopping, layout=replace(stopping.layout, restitution=tuple(kept)))
    rows = chooser.table()
    return Fitted(model, stopping, judged.fit, *final, division, tuple(found), bounces, rows)


def _by_name(system: System, model: Model) -> Iterable[tuple[str, float]]:
    return zip(system.velocity_of, model.layout.restitution, strict=True)


def _choose(task: Task, samples: Samples, division: Division, config: IdentifyConfig) -> Chooser:
    prior = PhysicsPrior(task.system).double()
    name = "rk4" if config.integrator == AUTO else config.integrator
    integrator = make_integrator(name, substeps=config.substeps or 1)
    layout = task.system.layout(task.velocity_limits)  # no fitted window meets a stop
    model = Model(prior, layout, integrator, given_path(config))
    windows = make_windows(samples, spread(division.short, WINDOWS))
    chooser = Chooser(Trials(samples, windows), model, config)
    chooser.choose_all()
    return chooser


def _stops_matter(chooser: Chooser, samples: Samples, division: Division) -> bool:
    """Whether the equations fail at stops that were only suspected."""
    stopped = division.stopped
    whole = cut(runs(samples, torch.ones_like(stopped)), TRIAL, LEAST)
    spans = [(a, b) for a, b in whole if bool(stopped[a:b].any())]
    if not spans:
        return False
    best, trials = chooser.best, chooser.trials
    windows = make_windows(samples, spread(spans, 40))
    shooting = Shooting(best.model, samples, windows)
    starts = first_starts(best.model.prior.system, windows)
    fit = shooting.fit(trials.noise(best), best.raw, starts, iterations=6, learn=False)
    return fit.cost / max(int(windows.mask.sum()), 1) > _FAILS * trials.cost(best, best)


class _All(NamedTuple):
    fit: Fit
    windows: Windows
    outlying: int


def _fit_all(
    model: Model,
    samples: Samples,
    spans: Sequence[Span],
    config: IdentifyConfig,
    raw: Tensor,
    sigma: Tensor,
) -> _All:
    """Fit spans; windows that the equations do not describe at all are left out at last."""
    windows = make_windows(samples, spread(spans, config.windows))
    starts = first_starts(model.prior.system, windows)
    fit = settle(Shooting(model, samples, windows), raw, starts, sigma)
    squares = (fit.residual / fit.sigma).square().sum((1, 2))
    size = squares / windows.mask.sum((1, 2)).clamp_min(1)
    good = size <= _OUTLYING * size.median().clamp_min(0.1)
    if bool(good.all()):
        return _All(fit, windows, 0)
    windows = windows.take(good)
    fit = settle(Shooting(model, samples, windows), fit.raw, fit.starts[good], fit.sigma)
    return _All(fit, windows, int((~good).sum()))
