"""Errors of predictions over samples that took no part in the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.identification.division import Division, spread
from phihp_torchrl.identification.held_out import BINS, Span, region
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.parts import HorizonError, Region, Rollout, StateError
from phihp_torchrl.identification.restitution import RUN_UP, hits
from phihp_torchrl.identification.shooting import Fit, Shooting, simulate
from phihp_torchrl.identification.windows import (
    Samples,
    Windows,
    cut,
    first_starts,
    make_windows,
    runs,
)
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.recordings import Recording

_PICTURES = 6
"""Predictions of which the samples are kept."""
_AT_STOPS = 40
"""Stretches at stops that are predicted."""
_SUBSTEPS = 8
"""Steps of the integrator between two samples where stops are met."""
_STRIDE = 5
"""Samples from one prediction to the next."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of held-out samples.

    The start of each is estimated from the samples before it alone, by fitting a trajectory of the
    model to them, its constants as they are. Those earlier samples may have been fitted; those that
    are predicted have not.

    Args:
        windows: the samples before and after, ``[W, L]``.
        origin: place of the last sample that is known, ``[W]``.
        states: the fitted past and the prediction, ``[W, L, n]``.
    """

    windows: Windows
    origin: Tensor
    states: Tensor


def predict(
    model: Model,
    samples: Samples,
    raw: Tensor,
    sigma: Tensor,
    held: Sequence[Span],
    inside: Sequence[Span],
    past: tuple[int, int],
    ahead: int,
) -> Predictions | None:
    """Predict ``ahead`` steps from places in held-out spans.

    Args:
        model: the equations.
        samples: the recordings.
        raw: parameters.
        sigma: noise of each state.
        held: held-out spans.
        inside: the spans that hold them, in which a past may reach back.
        past: samples of the past, at least and at most.
        ahead: steps.

    Returns:
        The predictions, or ``None`` where no span is long enough.
    """
    spans, origins = [], []
    for a, b in held:
        begin = next(x for x, y in inside if x <= a and b <= y)
        for last in range(max(a - 1, begin + past[0] - 1), b - ahead, _STRIDE):
            first = max(begin, last + 1 - past[1])
            spans.append((first, last + ahead + 1))
            origins.append(last - first)
    return _from(model, samples, raw, sigma, spans, origins) if spans else None


def _from(
    model: Model,
    samples: Samples,
    raw: Tensor,
    sigma: Tensor,
    spans: Sequence[Span],
    origins: Sequence[int],
    through: Model | None = None,
) -> Predictions:
    """Predict each span after its origin, by the equations ``through`` where those are others."""
    windows, origin = make_windows(samples, spans), torch.tensor(origins)
    known = torch.arange(windows.mask.shape[1]) <= origin[:, None]
    seen = windows._replace(mask=windows.mask & known[..., None])
    starts = first_starts(model.prior.system, seen)
    fit = Shooting(model, samples, seen).fit(sigma, raw, starts, iterations=10, learn=False)
    acting = model.acting(samples, raw)[windows.index]
    states = simulate(through or model, raw, fit.starts, acting, windows)
    return Predictions(windows, origin, states)


def horizon_error(
    names: Sequence[str], found: Predictions, sigma: Tensor, steps: int, among: Tensor | None = None
) -> HorizonError:
    """Errors some steps ahead, of some of the predictions.

    Args:
        names: of the states.
        found: the predictions.
        sigma: noise of each state.
        steps: steps ahead.
        among: which predictions, bool ``[W]``; by default all.
    """
    rows = torch.arange(len(found.origin))
    at = found.origin + steps
    error = (found.states - found.windows.measured)[rows, at]
    mask = found.windows.mask[rows, at]
    if among is not None:
        mask = mask & among[:, None]
    before = found.windows.mask[rows, found.origin] & mask
    change = found.windows.measured[rows, at] - found.windows.measured[rows, found.origin]
    states = {}
    for i, name in enumerate(names):
        if not mask[:, i].any():
            continue
        rmse = error[mask[:, i], i].square().mean().sqrt().item()
        moved = change[before[:, i], i].square().mean().sqrt().item()
        share = rmse / moved if moved > 0 else float("nan")
        states[name] = StateError(rmse, share, rmse / sigma[i].item(), int(mask[:, i].sum()))
    return HorizonError(
        states, _whole([e.share for e in states.values()]),
        _whole([e.floor_ratio for e in states.values()]),
    )  # fmt: skip


def _whole(values: Sequence[float]) -> float:
    known = [v for v in values if v == v]
    return (sum(v * v for v in known) / len(known)) ** 0.5 if known else float("nan")


def by_regions(names: Sequence[str], found: Predictions, sigma: Tensor, steps: int) -> list[Region]:
    """Errors by thirds of the range of each state, by where a prediction starts."""
    rows = torch.arange(len(found.origin))
    begun = found.states[rows, found.origin]
    regions = []
    for i, name in enumerate(names):
        low, high = begun[:, i].min(), begun[:, i].max()
        part = region(begun[:, i], low, high)
        for k in range(BINS):
            among = part == k
            begin, end = (float(low + (high - low) * j / BINS) for j in (k, k + 1))
            error = horizon_error(names, found, sigma, steps, among)
            regions.append(Region(name, begin, end, int(among.sum()), error.states))
    return regions


def pictures(
    names: Sequence[str],
    actions: Sequence[str],
    found: Predictions,
    samples: Samples,
    recordings: Sequence[Recording],
    count: int,
    *,
    at_stop: bool = False,
) -> list[Rollout]:
    """Some of the predictions, spread over all of them."""
    rollouts = []
    chosen = torch.linspace(0, len(found.origin) - 1, min(count, len(found.origin))).round().long()
    for w in chosen.tolist():
        windows = found.windows.take(torch.tensor([w]))
        length = 1 + int((windows.interval[0] > 0).sum())
        index = windows.index[0, :length]
        recording = recordings[int(samples.stretch[index[0]])]
        measured = {
            name: [v if v == v else None for v in samples.state[index, i].tolist()]
            for i, name in enumerate(names)
        }
        rollouts.append(
            Rollout(
                source=recording.source,
                episode=recording.episode,
                begin=int(found.origin[w]) + 1,
                time=samples.time[index].tolist(),
                measured=measured,
                predicted={n: found.states[w, :length, i].tolist() for i, n in enumerate(names)},
                action={n: samples.action[index, i].tolist() for i, n in enumerate(actions)},
                at_stop=at_stop,
            )
        )
    return rollouts


class Judged(NamedTuple):
    """Errors by steps ahead, errors by regions at the longest horizon, and pictures."""

    errors: dict[str, HorizonError]
    regions: list[Region]
    rollouts: list[Rollout]


def judge_predictions(
    model: Model,
    samples: Samples,
    fit: Fit,
    division: Division,
    past: tuple[int, int],
    recordings: Sequence[Recording],
) -> Judged:
    """Predict what was held out, and, apart from that, what happens at stops."""
    names, actions = model.prior.system.state_names, model.prior.system.action_names
    if not division.held:
        return Judged({}, [], [])
    ahead = division.horizons[-1]
    plain = (model, samples, fit.raw, fit.sigma)
    found = predict(*plain, division.held, division.inside, past, ahead)
    if found is None:
        return Judged({}, [], [])
    errors = {h: horizon_error(names, found, fit.sigma, h) for h in division.horizons}
    regions = by_regions(names, found, fit.sigma, ahead)
    rollouts = pictures(names, actions, found, samples, recordings, _PICTURES)
    met = _at_stops(model, samples, fit, division, past, ahead)
    if met is not None:
        error = horizon_error(names, met, fit.sigma, ahead)
        regions.append(Region("stop", None, None, len(met.origin), error.states))
        rollouts += pictures(names, actions, met, samples, recordings, 2, at_stop=True)
    return Judged({str(h): error for h, error in errors.items()}, regions, rollouts)


def _at_stops(
    model: Model,
    samples: Samples,
    fit: Fit,
    division: Division,
    past: tuple[int, int],
    ahead: int,
) -> Predictions | None:
    """Predictions through hits of stops, from clear run-ups to them if there are some."""
    system = model.prior.system
    spans = [
        span
        for name, stop in division.stops.items()
        for span in hits(samples, system.state_names.index(name), stop, ahead)
    ]
    if spans:
        # A hit falls between two samples.
        integrator = make_integrator(model.integrator.name, substeps=_SUBSTEPS)
        fine, few = replace(model, integrator=integrator), spread(spans, _AT_STOPS)
        return _from(model, samples, fit.raw, fit.sigma, few, [RUN_UP] * len(few), fine)
    whole = runs(samples, torch.ones_like(division.stopped))
    near = [(a, b) for a, b in cut(whole, ahead + 10, ahead) if division.stopped[a:b].any()]
    few = spread(near, _AT_STOPS)
    return predict(model, samples, fit.raw, fit.sigma, few, whole, past, ahead)
