"""Which samples are fitted, which are held out, and which meet stops and are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification.config import IdentifyConfig
from phihp_torchrl.identification.held_out import Span, hold_out
from phihp_torchrl.identification.stops import Stops, at_stops
from phihp_torchrl.identification.windows import Samples, cut, runs
from phihp_torchrl.systems import System

LEAST = 8
"""Samples that a fitted window has at least."""
TRIAL = 25
"""Samples of a window in a trial."""
_FEW, _SHORT = 4, 20
"""Windows below which they are halved, as long as halves have so many samples."""


@dataclass(frozen=True)
class Division:
    """What becomes of each sample.

    Args:
        stops: lowest and highest values of positions.
        stopped: which samples are left out for them, bool ``[N]``.
        inside: spans of the others.
        held: spans that are held out.
        spans: windows that are fitted.
        short: the same samples in shorter windows, for trials.
        past: samples that a prediction has before it at least.
        horizons: steps ahead that the held-out spans are long enough for.
        window: samples in a fitted window at most, fewer than asked for where recordings are short.
    """

    stops: Stops
    stopped: Tensor
    inside: list[Span]
    held: list[Span]
    spans: list[Span]
    short: list[Span]
    past: int
    horizons: list[int]
    window: int


def divide(system: System, samples: Samples, stops: Stops, config: IdentifyConfig) -> Division:
    """Leave out samples at stops, hold out blocks of the others, and cut the rest into windows.

    Raises:
        ConfigError: if fewer than two windows are left.
    """
    stopped = at_stops(system, samples, stops)
    inside = runs(samples, ~stopped)
    longest = max((b - a for a, b in inside), default=0)
    kept, past = inside, LEAST
    held: list[Span] = []
    horizons: list[int] = []
    for least in (config.past // 2, LEAST):  # a short past only where there is no longer one
        able = [h for h in config.horizons if h + least <= longest]
        if able and not held:
            past, horizons = least, able
            kept, held = hold_out(samples, inside, 2 * able[-1] + 10, least, able[-1])
    window = config.window
    spans = cut(kept, window, LEAST)
    while len(spans) < _FEW and window >= 2 * _SHORT:
        window //= 2
        spans = cut(kept, window, LEAST)
    if len(spans) < 2:
        raise ConfigError(
            "recordings",
            f"expected at least two windows of {LEAST} samples away from stops, got {len(spans)}.",
        )
    short = cut(kept, min(TRIAL, config.window), LEAST)
    return Division(stops, stopped, inside, held, spans, short, past, horizons, window)


def spread(spans: Sequence[Span], most: int) -> list[Span]:
    """At most so many of the spans, at equal distances."""
    if len(spans) <= most:
        return list(spans)
    return [spans[round(i * (len(spans) - 1) / (most - 1))] for i in range(most)]
