"""What a reader must know before trusting a fit, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from phihp_torchrl.identification.fitting import Fitted
from phihp_torchrl.identification.parts import (
    AT_LIMIT,
    FIXED,
    IDENTIFIED,
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

BEFORE = 5
"""How many previous commands are looked at."""
_EXPLAINED = 0.1
_WHITE = 0.3
_OVER = 2.0
_EXACT = 1e-5  # residuals below this share of the motion are those of the integrator
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
        elif c.verdict not in (IDENTIFIED, FIXED):
            groups.setdefault(c.advice, []).append(name)
    for advice, names in groups.items():
        text = f"Of {', '.join(names)} only combinations are identified."
        found.append(Finding("combination", text, advice))
    return found


def of_residuals(
    system: System, samples: Samples, windows: Windows, fit: Fit
) -> tuple[list[Finding], Residuals]:
    """Whether residuals are white, and whether previous commands explain them."""
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
        share = max(_explained(samples, windows, r, mask, i) for i in (0, 2))
        if share > _EXPLAINED:
            found.append(
                Finding(
                    "delay",
                    f"{name}: the commands before explain {100 * share:.0f} % of the residual.",
                    "The command acts late or slowly: let delay and lag be 'auto', or allow a "
                    "larger largest_delay.",
                )
            )
    return found, _residuals(system, samples, windows, fit, white)


def _explained(
    samples: Samples, windows: Windows, r: Tensor, mask: Tensor, differences: int
) -> float:
    """Share of the residuals (or their second differences) that previous commands explain."""
    index = windows.index[:, differences:]
    good = mask
    for _ in range(differences):
        r, good = r.diff(dim=1), good[:, 1:] & good[:, :-1]
    known = good & (index - BEFORE - differences >= samples.first[index])
    columns = [
        samples.action[(index[known] - k).clamp_min(0)] for k in range(BEFORE + differences + 1)
    ]
    x, y = torch.cat(columns, -1), r[known]
    if len(y) < 20 * x.shape[1]:
        return 0.0
    x, y = x - x.mean(0), y - y.mean()
    solution = torch.linalg.lstsq(x, y[:, None], driver="gelsd").solution
    left = (y - (x @ solution)[:, 0]).square().mean() / y.square().mean().clamp_min(1e-300)
    return 1.0 - float(left)


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
    ratios = [error.floor_ratio for error in errors[steps].states.values()]
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
        for name, error in errors[steps].states.items()
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
