"""How a position leaves a stop: the share of its speed that is left, from what follows a hit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from phihp_torchrl.identification.division import spread
from phihp_torchrl.identification.held_out import Span
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.parts import IDENTIFIED, NOT_IDENTIFIED, Estimate
from phihp_torchrl.identification.shooting import Fit, Shooting, robust, simulate
from phihp_torchrl.identification.stops import Stops, noise_level
from phihp_torchrl.identification.windows import Samples, Windows, first_starts, make_windows
from phihp_torchrl.integrators import make_integrator

_PAST, _AHEAD, _MARGIN = 20, 12, 2
"""Samples before a hit, from which the state is estimated, after it, and beside it."""
_BAND = 5.0
"""Standard deviations of the noise within which a position counts as at its stop."""
RUN_UP = _PAST - _MARGIN
"""Samples of a span before the first that is predicted."""
_HITS = 60
"""Hits that are looked at."""
_LEAST = 4
"""Hits without which nothing is said."""
_FINE = 0.01
"""Distance of the values that are tried around the best tenth."""
_MOVED = (-2.0, 0.0, 2.0, 4.0)
"""Standard deviations of the noise by which stops may lie further out."""
_DRAWS = 400
"""Draws of the hits with replacement, from which the interval comes (Efron, 1979)."""
_SUBSTEPS = 4
"""Steps of the integrator between two samples, as a hit falls between them."""
_WIDE = 0.15
"""Width of the interval from which on the hits tell nothing."""


def fit_restitution(
    model: Model, stopping: Model, samples: Samples, fit: Fit, stops: Stops
) -> dict[str, Estimate]:
    """Restitution of each position that has stops, by its name.

    Trajectories are fitted to the samples before each hit alone, and go on through it with every
    value that is tried. The value that predicts the samples after the hits best is the estimate;
    its interval is that of the same for draws of the hits with replacement.

    Args:
        model: the equations without stops.
        stopping: the same with stops.
        samples: the recordings.
        fit: parameters and noise.
        stops: lowest and highest values by the name of a position.
    """
    system, found = model.prior.system, {}
    for pair, name in enumerate(system.velocity_of):
        if name not in stops:
            continue
        spans = spread(hits(samples, system.state_names.index(name), stops[name]), _HITS)
        guess = stopping.layout.restitution[pair]
        if len(spans) < _LEAST:
            advice = f"Record more hits of its stops; there are {len(spans)} with a clear run-up."
            found[name] = Estimate(guess, guess, None, None, NOT_IDENTIFIED, advice)
        else:
            follow = _Follow(model, stopping, samples, fit, spans, pair)
            found[name] = _judge(guess, follow)
    return found


def hits(
    samples: Samples, column: int, stop: tuple[float, float], ahead: int = _AHEAD
) -> list[Span]:
    """Spans around samples at which a position reaches a stop after a run-up away from it."""
    values = samples.state[:, column]
    band = _BAND * float(noise_level(samples)[column].nan_to_num())
    at = ((values > stop[1] - band) | (values < stop[0] + band)).tolist()
    spans = []
    for i in range(_PAST, len(at) - ahead):
        first, last = i - _PAST, i + ahead
        whole = bool(samples.stretch[first] == samples.stretch[last])
        if at[i] and whole and not any(at[first:i]):
            spans.append((first, last + 1))
    return spans


class _Follow:
    """Predictions through hits from where the run-up of each ends, for values of a restitution."""

    def __init__(
        self,
        model: Model,
        stopping: Model,
        samples: Samples,
        fit: Fit,
        spans: Sequence[Span],
        pair: int,
    ) -> None:
        integrator = make_integrator(stopping.integrator.name, substeps=_SUBSTEPS)
        self.model, self.pair = replace(stopping, integrator=integrator), pair
        self.fit, self.count = fit, len(spans)
        windows = make_windows(samples, spans)
        begin = RUN_UP
        before = torch.arange(windows.mask.shape[1]) <= begin
        seen = windows._replace(mask=windows.mask & before[:, None])
        starts = first_starts(model.prior.system, seen)
        shooting = Shooting(model, samples, seen)
        known = shooting.fit(fit.sigma, fit.raw, starts, iterations=10, learn=False)
        self.starts = known.states[:, begin]
        self.acting = model.acting(samples, fit.raw)[windows.index][:, begin:]
        self.after = Windows(
            windows.index[:, begin:],
            windows.measured[:, begin:],
            windows.mask[:, begin:],
            windows.time[:, begin:],
            windows.interval[:, begin:],
        )

    def loss(self, value: float, moved: float = 0.0) -> Tensor:
        """Robust loss after each hit, ``[hits]``, with stops moved outwards by so many σ."""
        bounces = list(self.model.layout.restitution)
        bounces[self.pair] = value
        stops = list(self.model.layout.stops)
        low, high = stops[self.pair]
        shift = moved * float(self.fit.sigma[self.model.layout.pairs[self.pair][0]])
        stops[self.pair] = (low - shift, high + shift)
        layout = replace(self.model.layout, restitution=tuple(bounces), stops=tuple(stops))
        model = replace(self.model, layout=layout)
        states = simulate(model, self.fit.raw, self.starts, self.acting, self.after)
        error = (states - self.after.measured) / self.fit.sigma
        return robust(torch.where(self.after.mask, error, 0.0)[:, 1:]).sum((1, 2))


def _judge(guess: float, follow: _Follow) -> Estimate:
    """The value of the least loss, and where it lies for draws of the hits."""
    tenths = [i / 10 for i in range(11)]
    coarse = min(tenths, key=lambda value: float(follow.loss(value).sum()))
    steps = range(-10, 11)
    values = [v for i in steps if 0.0 <= (v := round(coarse + i * _FINE, 6)) <= 1.0]
    # Where samples pile up is not quite where the stop is.
    moved = min(
        _MOVED,
        key=lambda m: min(float(follow.loss(v, m).sum()) for v in values[:: len(values) // 4]),
    )
    losses = torch.stack([follow.loss(value, moved) for value in values])
    generator = torch.Generator().manual_seed(0)
    draws = torch.randint(follow.count, (_DRAWS, follow.count), generator=generator)
    tried = torch.tensor(values, dtype=torch.float64)
    least = tried[losses[:, draws].sum(-1).argmin(0)]
    value = values[int(losses.sum(1).argmin())]
    ends = (float(torch.quantile(least, q)) for q in (0.025, 0.975))
    low, high = (end + side * _FINE / 2 for end, side in zip(ends, (-1, 1), strict=True))
    low, high = max(min(low, value), 0.0), min(max(high, value), 1.0)
    if high - low > _WIDE or low <= values[0] - _FINE / 2 > 0 or high >= values[-1] < 1:
        advice = "Record more hits, faster ones, or hits with less force behind them."
        return Estimate(guess, guess, None, None, NOT_IDENTIFIED, advice)
    return Estimate(guess, value, low, high, IDENTIFIED)
