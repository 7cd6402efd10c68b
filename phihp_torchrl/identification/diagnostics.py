"""What a reader must know before trusting a fit, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from phihp_torchrl.identification.config import AUTO, IdentifyConfig
from phihp_torchrl.identification.fitting import Fitted
from phihp_torchrl.identification.parts import (
    AT_LIMIT,
    FIXED,
    IDENTIFIED,
    IF_COMPLETE,
    NOT_IDENTIFIED,
    Estimate,
    Finding,
    HorizonError,
    Residuals,
)
from phihp_torchrl.identification.shooting import Fit
from phihp_torchrl.identification.stops import Stops
from phihp_torchrl.identification.windows import Samples, Windows
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Actuator

BEFORE = 5
"""How many previous commands are looked at."""
_EXPLAINED = 0.2
_WHITE = 0.3
_ROWS = 20  # samples that a regression needs for each column
_STRIDE = 4  # samples over which residuals are compared
_OVER = 2.0
_EXACT = 1e-5  # residuals below this share of the motion are those of the integrator
_HARMLESS = 2e-3  # errors below this share of the change are small, however small the noise is
_MISFIT = 3.0  # ratio of the error of predictions to the noise at which intervals are doubted


def of_constants(constants: Mapping[str, Estimate]) -> list[Finding]:
    """Constants that the data do not determine, and those at a limit."""
    found = []
    groups: dict[str, list[str]] = {}
    for name, c in constants.items():
        if c.verdict == AT_LIMIT:
            text = f"{name} is at its limit ({c.estimate:.4g})."
            found.append(Finding("limit", text, c.advice))
        elif c.verdict == NOT_IDENTIFIED:
            found.append(Finding("unknown", f"{name} is not identified by these data.", c.advice))
        elif c.verdict == IF_COMPLETE:
            text = f"{name} is identified only if the equations are complete, which they are not."
            found.append(Finding("complete", text, c.advice))
        elif c.verdict not in (IDENTIFIED, FIXED):
            groups.setdefault(c.advice, []).append(name)
    for advice, names in groups.items():
        text = f"Of {', '.join(names)} only combinations are identified."
        found.append(Finding("combination", text, advice))
    return found


def late_advice(config: IdentifyConfig, path: Actuator) -> str:
    """What to do where commands act late, of what was not done already.

    Examples:
        >>> late_advice(IdentifyConfig(lag=0.0), Actuator())
        "The command acts late or slowly: let lag be 'auto'."
        >>> late_advice(IdentifyConfig(largest_delay=2), Actuator(delay_steps=1.8))
        'The command acts late or slowly: allow a larger largest_delay than 2.'
    """
    given = [name for name in ("delay", "lag") if getattr(config, name) != AUTO]
    todo = [f"let {' and '.join(given)} be 'auto'"] if given else []
    delays = path.delay_steps if isinstance(path.delay_steps, tuple) else (path.delay_steps,)
    if config.delay == AUTO and max(delays) > config.largest_delay - 1:
        todo.append(f"allow a larger largest_delay than {config.largest_delay}")
    what = ", or ".join(todo) or (
        "in another way than the delays and lags that were tried. See whether the time stamps are "
        "those of the samples, and what the drive does to a command"
    )
    return f"The command acts late or slowly{':' if todo else ','} {what}."


def of_residuals(
    system: System, samples: Samples, windows: Windows, fit: Fit, late: str
) -> tuple[list[Finding], Residuals]:
    """Whether residuals are white, and whether previous commands explain them.

    Args:
        system: names of the states.
        samples: the recordings.
        windows: what was fitted.
        fit: what is left over.
        late: what to do where commands before explain it.
    """
    found, white = [], {}
    steps = torch.arange(1, BEFORE + 1)
    for i, name in enumerate(system.state_names):
        mask = windows.mask[..., i]
        moved = windows.measured[..., i][mask]
        if not len(moved) or float(fit.sigma[i]) < _EXACT * float(moved.std()):
            continue
        r = fit.residual[..., i] / fit.sigma[i]
        r = torch.where(mask, r.clamp(-5.0, 5.0), 0.0)
        power = r[mask].square().mean().clamp_min(1e-300)
        white[name] = [
            float(
                (r[:, k:] * r[:, :-k]).sum()
                / (mask[:, k:] & mask[:, :-k]).sum().clamp_min(1)
                / power
            )
            for k in steps.tolist()
        ]
        if white[name][0] > _WHITE:
            found.append(
                Finding(
                    "white",
                    f"{name}: residuals one sample apart agree (correlation {white[name][0]:.2f}).",
                    "The equations leave something out: add the term that is missing (friction, a "
                    "spring, a stop) to the prior, or let a residual learn it.",
                )
            )
        # A force shows in the first difference of a velocity, and the second of a position.
        differences = 2 if name in system.velocity_of else 1
        share = _explained(samples, windows, fit.states, r, mask, differences)
        if share > _EXPLAINED:
            found.append(
                Finding(
                    "delay",
                    f"{name}: the commands before explain {100 * share:.0f} % of the residual.",
                    late,
                )
            )
    return found, _residuals(system, samples, windows, fit, white)


def _explained(
    samples: Samples, windows: Windows, states: Tensor, r: Tensor, mask: Tensor, differences: int
) -> float:
    """Share of the residuals' differences that commands before explain.

    Differences are taken over a few samples, in which the effect of a command adds up and noise
    does not. What is linear in the sum of their commands, weighted as a force acts, and in the
    states now and before is taken away from both: a wrong gain goes with the former, and friction
    that the equations leave out with the speeds, which the commands before have caused.
    """
    span = differences * _STRIDE
    good, weight = mask, torch.ones(1, dtype=r.dtype)
    for _ in range(differences):
        r = r[:, _STRIDE:] - r[:, :-_STRIDE]
        good = good[:, _STRIDE:] & good[:, :-_STRIDE]
        weight = torch.nn.functional.conv1d(
            weight[None, None], torch.ones(1, 1, _STRIDE, dtype=r.dtype), padding=_STRIDE - 1
        )[0, 0]
    index = windows.index[:, span:]
    known = good & (index - BEFORE - span >= samples.first[index])
    commands = [samples.action[(index[known] - k).clamp_min(0)] for k in range(BEFORE + span + 1)]
    place = torch.arange(span, states.shape[1])
    passed = [states[:, place - k][known] for k in (0, span // 2, span)]
    summed = sum(w * commands[k] for k, w in enumerate(weight.tolist(), start=1))
    own, before = torch.cat([*passed, summed], -1), torch.cat(commands, -1)
    left = r[known][:, None]
    columns = own.shape[1] + before.shape[1] + 1
    if len(left) < _ROWS * columns:
        return 0.0
    own = (own - own.mean(0)) / own.std(0).clamp_min(1e-12)
    own = torch.cat([torch.ones_like(own[:, :1]), own], -1)
    left, before = (_without(own, values) for values in (left, before))
    ratio = _without(before, left).square().mean() / left.square().mean().clamp_min(1e-300)
    return 1.0 - float(ratio) * (len(left) - own.shape[1]) / (len(left) - columns)


def _without(columns: Tensor, values: Tensor) -> Tensor:
    """What is left of values ``[N, k]`` when their linear part in columns ``[N, c]`` is gone."""
    return values - columns @ torch.linalg.lstsq(columns, values, driver="gelsd").solution


def _residuals(
    system: System, samples: Samples, windows: Windows, fit: Fit, white: dict[str, list[float]]
) -> Residuals:
    """The residuals of real samples, as plain lists."""
    real = torch.cat([windows.interval > 0, windows.interval[:, -1:] > -1.0], 1)
    real[:, 1:] &= windows.time.diff(dim=1) > 0
    index = windows.index[real]
    residual = torch.where(windows.mask, fit.residual, torch.nan)[real]
    names, actions = system.state_names, system.action_names
    previous = {
        f"{name} {k} before": samples.action[
            torch.maximum(index - k, samples.first[index]), i
        ].tolist()
        for i, name in enumerate(actions)
        for k in range(1, BEFORE + 1)
    }
    return Residuals(
        time=samples.time[index].tolist(),
        residual={
            n: [v if v == v else None for v in residual[:, i].tolist()]
            for i, n in enumerate(names) if windows.mask[..., i].any()
        },
        state={n: fit.states[real][:, i].tolist() for i, n in enumerate(names)},
        action={n: samples.action[index, i].tolist() for i, n in enumerate(actions)},
        previous=previous,
        autocorrelation=white,
    )  # fmt: skip


def of_errors(errors: Mapping[str, HorizonError]) -> list[Finding]:
    """Predictions that are worse than the noise allows."""
    if not errors:
        return [
            Finding(
                "held_out",
                "No stretch is long enough to be held out, so no prediction was judged.",
                "Record longer stretches, or ask for shorter horizons.",
            )
        ]
    steps = max(errors, key=int)
    known = {n: e for n, e in errors[steps].states.items() if not e.share < _HARMLESS}
    ratios = [error.floor_ratio for error in known.values()]
    doubt = [
        Finding(
            "incomplete",
            "The equations do not describe the recordings to the noise, so constants may be wrong "
            "by more than their intervals say: those hold for complete equations.",
            "Add what the residuals point to, and see whether the constants move.",
        )
    ]
    return (doubt if max(ratios, default=0.0) > _MISFIT else []) + [
        Finding(
            "error",
            f"{name}: {steps} steps ahead the error is {error.rmse:.3g}, {error.floor_ratio:.1f} "
            f"times the noise and {100 * error.share:.2g} % of the change.",
            "Look at the residuals for what the equations leave out, and at the regions for where.",
        )
        for name, error in known.items()
        if error.floor_ratio > _OVER
    ]


def of_fit(stopped: Tensor, stops: Stops, fitted: Fitted) -> list[Finding]:
    """Samples at stops, and windows that the equations do not describe."""
    found = []
    if stopped.any():
        what = ", ".join(
            f"{n} at {' and '.join(f'{x:.4g}' for x in pair if math.isfinite(x))}"
            for n, pair in stops.items()
        )
        origin = "found in the data" if fitted.found else "known"
        found.append(
            Finding(
                "stops",
                f"{int(stopped.sum())} of {len(stopped)} samples at stops were left out ({what}; "
                f"{origin}).",
                "Use the task that this identification makes, or give yours these limits, so that "
                "imagination and planning stop there too; errors there are in the region 'stop'.",
            )
        )
    if fitted.outlying:
        found.append(
            Finding(
                "outliers",
                f"{fitted.outlying} of {fitted.outlying + len(fitted.windows.time)} windows are "
                "not described by the equations at all, and were left out.",
                "Look for contacts, outliers of a sensor, or commands that were not logged.",
            )
        )
    return found
