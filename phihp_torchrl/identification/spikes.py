"""Single samples that stand apart from those beside them, as a glitch of a sensor does."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.identification.parts import Finding
from phihp_torchrl.identification.stops import noise_level
from phihp_torchrl.identification.windows import Samples
from phihp_torchrl.systems import System

_FAR = 12.0
"""Standard deviations of the noise beyond which a sample may be a spike."""
_ROUGH = 5.0
"""How much further it must be away than curves of different order through those beside it."""
_STEPS = 0.95
"""Share of the changes from sample to sample than which a spike is larger."""
_BESIDE = (-2, -1, 1, 2)


def without_spikes(system: System, samples: Samples) -> tuple[Samples, list[Finding]]:
    """Leave out measurements that are far from a curve through the two before and the two after.

    A spike is far beyond the noise, and further than the state usually moves from one sample to the
    next. A hit or a step is none, for the samples after it do not go back to where those before it
    point.

    Args:
        system: names of the states.
        samples: the recordings.

    Returns:
        The samples, those measurements NaN, and what to say of them.
    """
    state, level, counts = samples.state.clone(), noise_level(samples), {}
    for i, name in enumerate(system.state_names):
        spiky = _spiky(samples, samples.state[:, i], float(level[i].nan_to_num()))
        if bool(spiky.any()):
            counts[name] = int(spiky.sum())
            state[spiky, i] = torch.nan
    if not counts:
        return samples, []
    what = ", ".join(f"{count} of {name}" for name, count in counts.items())
    text = f"Single measurements stand apart from those beside them and were left out: {what}."
    advice = "If they are real, the sampling is too slow for the motion; else look at the sensor."
    return samples._replace(state=state), [Finding("spikes", text, advice)]


def _spiky(samples: Samples, column: Tensor, level: float) -> Tensor:
    """Which measurements are spikes, bool ``[N]``."""
    found = torch.zeros(len(column), dtype=torch.bool)
    moved = column.diff().abs()
    moved = moved[moved.isfinite()]
    if len(column) < 5 or not len(moved):
        return found
    least = max(_FAR * level, float(torch.quantile(moved[:100_000], _STEPS)))
    middle = torch.arange(2, len(column) - 2)
    rows = middle[:, None] + torch.tensor(_BESIDE)
    time, value = samples.time[rows] - samples.time[middle, None], column[rows]
    cubic, line = _at_zero(time, value), _at_zero(time[:, 1:3], value[:, 1:3])
    away, rough = (column[middle] - cubic).abs(), (cubic - line).abs()
    inside = samples.stretch[middle - 2] == samples.stretch[middle + 2]
    far = (away > least) & (away > _ROUGH * rough)
    found[middle] = far & inside  # comparisons with NaN are false
    return found


def _at_zero(time: Tensor, value: Tensor) -> Tensor:
    """Lagrange's polynomial through ``[N, k]`` at time 0."""
    total = torch.zeros_like(value[:, 0])
    for i in range(time.shape[1]):
        weight = torch.ones_like(total)
        for j in range(time.shape[1]):
            if j != i:
                weight = weight * time[:, j] / (time[:, j] - time[:, i])
        total = total + weight * value[:, i]
    return total
