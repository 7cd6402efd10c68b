"""Samples at which a position meets a stop, where the equations of motion do not hold."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification.windows import Samples
from phihp_torchrl.systems import System

Stops = dict[str, tuple[float, float]]
"""Lowest and highest value by the name of a state; infinite where there is no stop."""

_BAND = 5.0
"""Standard deviations of the noise within which a position counts as at the stop."""
_PILE = 3.0
"""How much denser samples lie at a stop than beside it."""
_LEAST = 5
"""Samples at a stop, from which on there is one."""
_VISITS = 3
"""Visits to a stop; twice as many that all turn at the same place make one suspect by itself."""
_NARROW = 0.03
"""Share of the range that the same place is narrower than."""
_JUMP = 4.0
"""How much larger than usual a change of the speed is at which something was hit."""


def noise_level(samples: Samples) -> Tensor:
    """Standard deviation of each state's noise without any model, ``[n]``; NaN where not measured.

    Third differences leave little of a smooth motion, and their spread is that of the noise times
    the square root of 20. A sensor that counts has at least the noise of its rounding.
    """
    levels = []
    third_inside = samples.stretch[3:] == samples.stretch[:-3]
    inside = samples.stretch[1:] == samples.stretch[:-1]
    for column in samples.state.unbind(-1):
        third = column.diff(n=3)[third_inside]
        third = third[third.isfinite()].abs()
        first = column.diff()[inside].abs()
        steps = first[first > 0]
        rounding = steps.min() / 12**0.5 if len(steps) else column.new_tensor(0.0)
        spread = 1.4826 * third.median() / 20**0.5 if len(third) else rounding
        seen = column.isfinite().any()
        levels.append(torch.maximum(spread, rounding) if seen else column.new_tensor(torch.nan))
    return torch.stack(levels)


def check_stops(system: System, stops: Mapping[str, tuple[float, float]]) -> Stops:
    """Stops by the name of a state, checked.

    Raises:
        ConfigError: for an unknown state, or limits in the wrong order.
    """
    for name, pair in stops.items():
        if name not in system.state_names:
            raise ConfigError(
                f"stops.{name}", f"unknown state, expected some of {list(system.state_names)}."
            )
        if len(pair) != 2 or not pair[0] < pair[1]:
            raise ConfigError(f"stops.{name}", f"expected (low, high) with low < high, got {pair}.")
    return {name: (float(low), float(high)) for name, (low, high) in stops.items()}


def suspect_stops(system: System, samples: Samples) -> Stops:
    """Where samples pile up at the end of a position's range, as they do at a stop.

    A motion that turns by itself spends time there too, but no more than a few times that beside
    it, and seldom turns at the same place again. What bounces off a stop leaves few samples there,
    but its speed jumps. Whether the equations fail there, only a fit can tell.
    """
    found: Stops = {}
    level = noise_level(samples)
    for i, name in enumerate(system.state_names):
        column = samples.state[:, i]
        if name in system.angles or not column.isfinite().any():
            continue
        ends = [_pile(sign * column, samples, float(level[i])) for sign in (-1.0, 1.0)]
        low, high = ends
        if low is not None or high is not None:
            found[name] = (
                -float("inf") if low is None else -low,
                float("inf") if high is None else high,
            )
    return found


def _pile(column: Tensor, samples: Samples, level: float) -> float | None:
    """The upper end of a column if its samples pile up there."""
    known = column[column.isfinite()]
    band = max(8.0 * level, 1e-9 * float(known.abs().max()))
    top = float(known.max())
    at_top = column > top - band
    beside = ((known > top - 3.0 * band) & (known <= top - band)).sum() / 2.0
    count = int(at_top.sum())
    visits = int((at_top.diff().to(torch.int) != 0).sum()) // 2
    piled = count >= _PILE * float(beside)
    returns = visits >= 2 * _VISITS and band < _NARROW * float(top - known.min())
    stays = count >= _LEAST and visits >= _VISITS and (piled or returns)
    if not stays and _bounces(column, samples, level) < _VISITS:
        return None
    return float(column[at_top].median())


def _bounces(column: Tensor, samples: Samples, level: float) -> int:
    """How often the speed jumps downwards within a sample of the upper end of a column."""
    same = samples.stretch[2:] == samples.stretch[:-2]
    bend = torch.where(same, column.diff(n=2), 0.0).nan_to_num()
    moved = column.diff().abs()
    moved = moved[moved.isfinite()]
    if len(moved) < _LEAST:
        return 0
    top = float(column[column.isfinite()].max())
    reach = float(torch.quantile(moved[:100_000], 0.99))
    near = column[1:-1] > top - reach
    usual = bend[~near].abs()
    if not len(usual):
        return 0
    large = max(_JUMP * float(torch.quantile(usual[:100_000], 0.99)), 8.0 * level)
    jumps = near & (bend < -large)
    return int((jumps.diff().to(torch.int) == 1).sum())


def at_stops(system: System, samples: Samples, stops: Stops) -> Tensor:
    """Which samples are at a stop, would pass it before the next one, or are beside such, ``[N]``.

    Args:
        system: names of the states.
        samples: the recordings.
        stops: lowest and highest values.
    """
    met = torch.zeros(len(samples.time), dtype=torch.bool)
    level = noise_level(samples)
    for name, (low, high) in stops.items():
        i = system.state_names.index(name)
        column = samples.state[:, i]
        band = _BAND * float(level[i].nan_to_num())
        before = torch.cat([column[:1], column[:-1]])
        same = torch.cat([samples.stretch[:1], samples.stretch[:-1]]) == samples.stretch
        motion = torch.where(same, column - before, 0.0).nan_to_num()
        met |= (column.maximum(column + motion) > high - band).nan_to_num()
        met |= (column.minimum(column + motion) < low + band).nan_to_num()
    beside = met.clone()
    beside[1:] |= met[:-1]
    beside[:-1] |= met[1:]
    return beside
