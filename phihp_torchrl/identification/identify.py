"""From recordings to constants that can be trusted, or a word on why they cannot."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import PhysicsPrior
from phihp_torchrl.identification import diagnostics
from phihp_torchrl.identification.choices import Chooser, given_path
from phihp_torchrl.identification.config import AUTO, IdentifyConfig
from phihp_torchrl.identification.covariance import uncertainty
from phihp_torchrl.identification.errors import (
    LEAST_PAST,
    by_regions,
    horizon_error,
    horizon_errors,
    pictures,
    predict,
)
from phihp_torchrl.identification.experiments import Experiments
from phihp_torchrl.identification.held_out import Span, hold_out
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.parts import Finding, Region, Rollout
from phihp_torchrl.identification.result import Identification
from phihp_torchrl.identification.shooting import Fit, Shooting, settle
from phihp_torchrl.identification.stops import (
    Stops,
    at_stops,
    check_stops,
    noise_level,
    suspect_stops,
)
from phihp_torchrl.identification.trials import WINDOWS, Trials
from phihp_torchrl.identification.verdicts import (
    judge_actuator,
    judge_combinations,
    judge_constants,
    scale_of,
)
from phihp_torchrl.identification.windows import (
    Samples,
    Windows,
    cut,
    first_starts,
    gather,
    make_windows,
    runs,
)
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.recordings import Recording
from phihp_torchrl.tasks import Task

_LEAST = 8
"""Samples that a fitted window has at least."""
_TRIAL = 25
"""Samples of a window in a trial."""
_OUTLYING = 10.0
"""How much larger than usual the mean squared residual of a window is that is left out."""
_PICTURES = 6


def identify(
    task: Task, recordings: Sequence[Recording], config: IdentifyConfig | None = None
) -> Identification:
    """Fit the constants of a system, and the path of its commands, to recordings.

    The recordings are cut into windows, and trajectories of the system with free starts are fitted
    to what was measured in each (multiple shooting), with a robust loss. So neither noise nor
    velocities that were not measured bias the constants. Delay, lag and other parts of the actuator
    are kept where they clearly lower the error on windows that they were not fitted to. Every fifth
    block of samples, from every region of the states, takes no part, and predictions of it are
    judged.

    Args:
        task: the system with its first guesses, the bounds of the actions, limits.
        recordings: stretches of episodes; states that were not measured are NaN.
        config: how. Defaults to ``IdentifyConfig()``.

    Returns:
        Constants with intervals and verdicts, the actuator, errors, noise and warnings.

    Raises:
        ConfigError: for a system without a prior, recordings that do not fit to the task, or too
            few samples.

    Examples:
        >>> from phihp_torchrl.tasks import get_task
        >>> task = get_task("pendulum")
        >>> time, state = torch.arange(120) * 0.02, torch.tensor([3.0, 0.0]).double()
        >>> truth, states = task.system.with_constants({"length": 1.2}), []
        >>> layout, push = task.layout, torch.zeros(1)
        >>> for _ in time:
        ...     states.append(state)
        ...     field = lambda s: truth.prior(s, push, truth.constants)
        ...     state = make_integrator("rk4")(field, state, 0.02, layout)
        >>> swing = Recording(time, torch.stack(states), torch.zeros(120, 1))
        >>> found = identify(task, [swing], IdentifyConfig(integrator="rk4"))
        >>> round(found.combinations["gravity_gain"].estimate, 2)  # 1.5 * 10 / 1.2
        12.5
        >>> found.combinations["torque_gain"].verdict
        'not identified by these data'
    """
    begun = time.perf_counter()
    config = config or IdentifyConfig()
    system = task.system
    if not system.has_prior:
        raise ConfigError("system", f"{type(system).__name__} has no prior to fit.")
    samples = gather(system, recordings)
    if not samples.state.isfinite().any():
        raise ConfigError("recordings", "expected measured states, got NaN alone.")
    with torch.no_grad():
        work = _Work(task, samples, recordings, config)
        return work.report(begun)


class _Work:
    """The steps of an identification, in their order."""

    def __init__(
        self,
        task: Task,
        samples: Samples,
        recordings: Sequence[Recording],
        config: IdentifyConfig,
    ) -> None:
        self.task, self.samples, self.recordings, self.config = task, samples, recordings, config
        self.system = task.system
        known = {**(getattr(task, "position_limits", None) or {}), **config.stops}
        self.given = check_stops(self.system, known)
        suspected = suspect_stops(self.system, samples)
        self.suspected = {n: pair for n, pair in suspected.items() if n not in self.given}
        self._divide()
        self.chooser = self._choose()
        if self.suspected and not self._stops_matter():
            self.suspected = {}
            self._divide()
            self.chooser = self._choose()
        self.windows, self.fit, self.outlying = self._fit()
        self.model = self.chooser.settled()

    @property
    def stops(self) -> Stops:
        return {**self.given, **self.suspected}

    def _divide(self) -> None:
        """Leave out samples at stops, and hold out blocks of the others."""
        self.stopped = at_stops(self.system, self.samples, self.stops)
        self.inside = runs(self.samples, ~self.stopped)
        longest = max((b - a for a, b in self.inside), default=0)
        able = [h for h in self.config.horizons if h + LEAST_PAST <= longest]
        self.horizons = able
        ahead = max(able, default=1)
        kept, self.held = hold_out(
            self.samples, self.inside, 2 * ahead + 10, ahead + LEAST_PAST
        ) if able else (self.inside, [])  # fmt: skip
        self.spans = cut(kept, self.config.window, _LEAST)
        self.short = cut(kept, min(_TRIAL, self.config.window), _LEAST)
        if len(self.spans) < 2:
            raise ConfigError(
                "recordings",
                f"expected at least two windows of {_LEAST} samples away from stops, "
                f"got {len(self.spans)}.",
            )

    def _choose(self) -> Chooser:
        """The path of the command and the integrator."""
        prior = PhysicsPrior(self.system).double()
        config = self.config
        name = "rk4" if config.integrator == AUTO else config.integrator
        integrator = make_integrator(name, substeps=config.substeps or 1)
        model = Model(prior, self.task.layout, integrator, given_path(config))
        windows = make_windows(self.samples, _spread(self.short, WINDOWS))
        chooser = Chooser(Trials(self.samples, windows), model, config)
        chooser.choose_all()
        return chooser

    def _stops_matter(self) -> bool:
        """Whether the equations fail at stops that were only suspected."""
        spans = [
            (a, b)
            for a, b in cut(runs(self.samples, torch.ones_like(self.stopped)), _TRIAL, _LEAST)
            if bool(self.stopped[a:b].any())
        ]
        if not spans:
            return False
        best, trials = self.chooser.best, self.chooser.trials
        windows = make_windows(self.samples, _spread(spans, 40))
        sigma = trials.noise(best)
        shooting = Shooting(best.model, self.samples, windows)
        starts = first_starts(self.system, windows)
        fit = shooting.fit(sigma, best.raw, starts, iterations=6, learn=False)
        return fit.cost / max(int(windows.mask.sum()), 1) > 3.0 * trials.cost(best, best)

    def _fit(self) -> tuple[Windows, Fit, int]:
        """All windows; those that the equations do not describe at all are left out at last."""
        spans = _spread(self.spans, self.config.windows)
        windows = make_windows(self.samples, spans)
        best, model = self.chooser.best, self.chooser.settled()
        raw = best.raw
        starts = first_starts(self.system, windows)
        sigma = self.chooser.trials.noise(best)
        fit = settle(Shooting(model, self.samples, windows), raw, starts, sigma)
        size = (fit.residual / fit.sigma).square().sum((1, 2)) / windows.mask.sum((1, 2)).clamp_min(
            1
        )
        good = size <= _OUTLYING * size.median().clamp_min(0.1)
        if bool(good.all()):
            return windows, fit, 0
        windows = windows.take(good)
        shooting = Shooting(model, self.samples, windows)
        fit = settle(shooting, fit.raw, fit.starts[good], fit.sigma)
        return windows, fit, int((~good).sum())

    def report(self, begun: float) -> Identification:
        fit, model, samples = self.fit, self.model, self.samples
        names = self.system.state_names
        doubt = uncertainty(fit, scale_of(model, fit.raw))
        bounds = self.task.bounds
        experiments = Experiments(model, fit, samples, bounds.low.double(), bounds.high.double())
        constants = judge_constants(model, fit.raw, doubt, experiments.advise)
        findings = diagnostics.of_constants(constants)
        findings += diagnostics.of_recordings(self.system, samples)
        more, residuals = diagnostics.of_residuals(self.system, samples, self.windows, fit)
        findings += [*more, *self._left_out()]
        errors, regions, rollouts = self._errors()
        findings += diagnostics.of_errors(errors)
        measured = samples.state.isfinite().any(0)
        return Identification(
            constants=constants,
            combinations=judge_combinations(model, fit.raw, doubt),
            actuator=judge_actuator(model, fit.raw, doubt, self.chooser.table()),
            errors=errors,
            regions=tuple(regions),
            noise={n: float(fit.sigma[i]) for i, n in enumerate(names) if measured[i]},
            warnings=tuple(findings),
            data=self._data(),
            rollouts=tuple(rollouts),
            residuals=residuals,
            settings=self._settings(),
            seconds=time.perf_counter() - begun,
        )

    def _errors(self) -> tuple[dict[str, Any], list[Region], list[Rollout]]:
        if not self.held:
            return {}, [], []
        names, actions = self.system.state_names, self.system.action_names
        ahead, sigma = max(self.horizons), self.fit.sigma
        plain = (self.model, self.samples, self.fit.raw, sigma)
        found = predict(*plain, self.held, self.inside, self.config.past, ahead)
        if found is None:
            return {}, [], []
        errors = horizon_errors(names, found, sigma, self.horizons)
        regions = by_regions(names, found, sigma, ahead)
        rollouts = pictures(names, actions, found, self.samples, self.recordings, _PICTURES)
        whole = runs(self.samples, torch.ones_like(self.stopped))
        near = [s for s in cut(whole, ahead + 10, ahead) if bool(self.stopped[s[0] : s[1]].any())]
        if near:
            met = predict(*plain, _spread(near, 40), whole, self.config.past, ahead)
            if met is not None:
                every = torch.ones(len(met.origin), dtype=torch.bool)
                error = horizon_error(names, met, sigma, ahead, every)
                regions.append(Region("stop", None, None, len(every), error.states))
                rollouts += pictures(
                    names, actions, met, self.samples, self.recordings, 2, at_stop=True
                )
        return errors, regions, rollouts

    def _left_out(self) -> list[Finding]:
        found = []
        if self.stopped.any():
            what = ", ".join(
                f"{n} at {' and '.join(f'{x:.4g}' for x in pair if abs(x) < float('inf'))}"
                for n, pair in self.stops.items()
            )
            origin = "were found in the data" if self.suspected else "are known"
            found.append(
                Finding(
                    "stops",
                    f"{int(self.stopped.sum())} of {len(self.stopped)} samples at stops were left "
                    f"out ({what}; these {origin}).",
                    "Give the task its position limits, so that imagination and planning stop "
                    "there too; errors at stops are in the region 'stop'.",
                )
            )
        if self.outlying:
            found.append(
                Finding(
                    "outliers",
                    f"{self.outlying} of {self.outlying + len(self.windows.time)} windows are not "
                    "described by the equations at all, and were left out.",
                    "Look for contacts, outliers of a sensor or commands that were not logged.",
                )
            )
        return found

    def _data(self) -> dict[str, Any]:
        samples = self.samples
        missing = samples.state.isnan().sum(0).tolist()
        return {
            "samples": len(samples.time),
            "stretches": len(self.recordings),
            "episodes": len(samples.first.unique()),
            "step_s": samples.step,
            "missing": dict(zip(self.system.state_names, missing, strict=True)),
            "at_stops": int(self.stopped.sum()),
            "fitted_windows": len(self.windows.time),
            "fitted_samples": int(self.windows.mask.any(-1).sum()),
            "outlying_windows": self.outlying,
            "held_out_blocks": len(self.held),
            "held_out_samples": sum(b - a for a, b in self.held),
            "noise_without_model": {
                n: v
                for n, v in zip(self.system.state_names, noise_level(samples).tolist(), strict=True)
                if v == v
            },
        }

    def _settings(self) -> dict[str, Any]:
        integrator = self.model.integrator
        return {
            "integrator": integrator.name,
            **integrator.settings,
            "window": self.config.window,
            "stops": {n: list(pair) for n, pair in self.stops.items()},
            "starts_of_predictions": f"fitted to the {self.config.past} samples before, or to as "
            f"many as there are, {LEAST_PAST} at least",
        }


def _spread(spans: Sequence[Span], most: int) -> list[Span]:
    """At most so many of the spans, at equal distances."""
    if len(spans) <= most:
        return list(spans)
    return [spans[round(i * (len(spans) - 1) / (most - 1))] for i in range(most)]
