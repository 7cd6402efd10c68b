"""From recordings to constants that can be trusted, or a word on why they cannot."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import torch

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification import diagnostics
from phihp_torchrl.identification.completeness import doubted, loosen
from phihp_torchrl.identification.config import IdentifyConfig
from phihp_torchrl.identification.covariance import uncertainty
from phihp_torchrl.identification.errors import judge_predictions
from phihp_torchrl.identification.experiments import Experiments
from phihp_torchrl.identification.fitting import Fitted, fit_recordings
from phihp_torchrl.identification.logs import of_recordings
from phihp_torchrl.identification.parts import Finding
from phihp_torchrl.identification.result import Identification
from phihp_torchrl.identification.spikes import without_spikes
from phihp_torchrl.identification.stops import noise_level
from phihp_torchrl.identification.undecided import of_path
from phihp_torchrl.identification.verdicts import (
    judge_actuator,
    judge_combinations,
    judge_constants,
    scale_of,
)
from phihp_torchrl.identification.windows import Samples, gather
from phihp_torchrl.recordings import Recording
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task


def check_system(system: System) -> None:
    """Refuse a system of which there is nothing to fit, or whose inputs would be left out.

    Raises:
        ConfigError: for a system without a prior or with inputs.
    """
    name = type(system).__name__
    if not system.has_prior:
        raise ConfigError("system", f"{name} has no prior to fit.")
    if system.input_names:
        raise ConfigError(
            "inputs",
            f"{name} has inputs {system.input_names}, which are not reckoned with here; fit its "
            "constants by phase 1 (phihp train, with the columns of its inputs), which does.",
        )


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
        ConfigError: for a system without a prior or with inputs, recordings that do not fit to the
            task, or too few samples.

    Examples:
        >>> from phihp_torchrl.integrators import make_integrator
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
    check_system(task.system)
    samples = gather(task.system, recordings)
    if not samples.state.isfinite().any():
        raise ConfigError("recordings", "expected measured states, got NaN alone.")
    samples, spikes = without_spikes(task.system, samples)
    with torch.no_grad():
        fitted = fit_recordings(task, samples, config)
        return _report(task, samples, recordings, config, fitted, begun, spikes)


def _report(
    task: Task,
    samples: Samples,
    recordings: Sequence[Recording],
    config: IdentifyConfig,
    fitted: Fitted,
    begun: float,
    spikes: list[Finding],
) -> Identification:
    system, model, fit, division = task.system, fitted.model, fitted.fit, fitted.division
    doubt = uncertainty(fit, scale_of(model, fit.raw))
    low, high = task.bounds.low.double(), task.bounds.high.double()
    combinations = judge_combinations(model, fit.raw, doubt)
    combined = any(c.low is not None for c in combinations.values())
    experiments = Experiments(model, fit, samples, low, high, combined=combined)
    constants = judge_constants(model, fit.raw, doubt, experiments.advise)
    past = (division.past, config.past)
    judged = judge_predictions(fitted.stopping, samples, fitted.judged, division, past, recordings)
    late = diagnostics.late_advice(config, model.actuator(fit.raw))
    more, residuals = diagnostics.of_residuals(system, samples, fitted.windows, fit, late)
    beyond = diagnostics.of_errors(judged.errors)
    if any(finding.code in ("white", "incomplete") for finding in (*more, *beyond)):
        loose = loosen(fitted, samples)
        constants = doubted(constants, loose.constants)
        combinations = doubted(combinations, loose.combinations)
    warnings = [
        *diagnostics.of_constants(constants),
        *of_recordings(task, samples),
        *spikes,
        *more,
        *of_path(fitted.tried),
        *diagnostics.of_fit(division.stopped, division.stops, fitted),
        *beyond,
    ]
    measured = samples.state.isfinite().any(0).tolist()
    names = [name for name, known in zip(system.state_names, measured, strict=True) if known]
    return Identification(
        constants=constants,
        combinations=combinations,
        actuator=judge_actuator(model, fit.raw, doubt, fitted.tried),
        errors=judged.errors,
        regions=tuple(judged.regions),
        noise={n: float(fit.sigma[system.state_names.index(n)]) for n in names},
        warnings=tuple(warnings),
        restitution=fitted.restitution,
        stops={n: x for n, x in division.stops.items() if n in system.velocity_of},
        data=_data(task, samples, recordings, fitted),
        rollouts=tuple(judged.rollouts),
        residuals=residuals,
        settings=_settings(config, fitted),
        seconds=time.perf_counter() - begun,
    )


def _data(
    task: Task, samples: Samples, recordings: Sequence[Recording], fitted: Fitted
) -> dict[str, Any]:
    names, division = task.system.state_names, fitted.division
    missing = samples.state.isnan().sum(0).tolist()
    levels = zip(names, noise_level(samples).tolist(), strict=True)
    return {
        "samples": len(samples.time),
        "stretches": len(recordings),
        "episodes": len(samples.first.unique()),
        "step_s": samples.step,
        "missing": dict(zip(names, missing, strict=True)),
        "at_stops": int(division.stopped.sum()),
        "fitted_windows": len(fitted.windows.time),
        "fitted_samples": int(fitted.windows.mask.any(-1).sum()),
        "outlying_windows": fitted.outlying,
        "held_out_blocks": len(division.held),
        "held_out_samples": sum(b - a for a, b in division.held),
        "noise_without_model": {name: level for name, level in levels if level == level},
    }


def _settings(config: IdentifyConfig, fitted: Fitted) -> dict[str, Any]:
    integrator, division = fitted.model.integrator, fitted.division
    return {
        "integrator": integrator.name,
        **integrator.settings,
        "window": division.window,
        "starts_of_predictions": f"fitted to the {division.past} to {config.past} samples before, "
        "as many as there are",
    }
