"""Recordings as one table of samples, and the windows of it that are fitted together."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import Recording
from phihp_torchrl.systems import System


class Samples(NamedTuple):
    """All recordings, one after the other.

    Args:
        time: seconds, ``[N]``.
        state: measured states, NaN where they were not, ``[N, n]``.
        action: commands, ``[N, m]``.
        interval: seconds for which each command was held, ``[N]``; across a gap of one episode its
            whole length, and the median after the last sample of an episode.
        stretch: number of the recording of each sample, ``[N]``.
        first: index of the first sample of each sample's episode, ``[N]``.
        place: index of each sample in its recording, ``[N]``.
    """

    time: Tensor
    state: Tensor
    action: Tensor
    interval: Tensor
    stretch: Tensor
    first: Tensor
    place: Tensor

    @property
    def step(self) -> float:
        """The usual time between two samples, in seconds."""
        inside = self.stretch[1:] == self.stretch[:-1]
        return float(self.interval[:-1][inside].median())


def gather(system: System, recordings: Sequence[Recording]) -> Samples:
    """Put recordings together.

    Args:
        system: says how many states and actions there must be.
        recordings: stretches of episodes, in the order of time.

    Raises:
        ConfigError: for no recordings, other numbers of states or actions, and infinite values.
    """
    if not recordings:
        raise ConfigError("recordings", "expected one or more, got none.")
    for recording in recordings:
        sizes = (recording.state.shape[1], recording.action.shape[1])
        if sizes != (system.state_dim, system.action_dim):
            raise ConfigError(
                "recordings",
                f"{recording.source}: expected columns for {system.state_names} and "
                f"{system.action_names}, got {sizes[0]} and {sizes[1]}.",
            )
        if recording.state.isinf().any():
            raise ConfigError("recordings", f"{recording.source}: expected finite states or NaN.")
    usual = torch.cat([r.intervals for r in recordings]).median()
    interval: list[Tensor] = []
    first: list[Tensor] = []
    begun, offset = 0, 0
    for i, r in enumerate(recordings):
        before = recordings[i - 1] if i else None
        goes_on = before is not None and _follows(before, r)
        if goes_on and before is not None:
            interval[-1][-1] = r.time[0] - before.time[-1]
        begun = begun if goes_on else offset
        interval.append(torch.cat([r.intervals, usual[None]]))
        first.append(torch.full((len(r),), begun))
        offset += len(r)
    lengths = torch.tensor([len(r) for r in recordings])
    return Samples(
        time=torch.cat([r.time for r in recordings]),
        state=torch.cat([r.state for r in recordings]),
        action=torch.cat([r.action for r in recordings]),
        interval=torch.cat(interval),
        stretch=torch.arange(len(recordings)).repeat_interleave(lengths),
        first=torch.cat(first),
        place=torch.cat([torch.arange(len(r)) for r in recordings]),
    )


def _follows(before: Recording, after: Recording) -> bool:
    return before.episode == after.episode and bool(after.time[0] > before.time[-1])


class Windows(NamedTuple):
    """Stretches that start where they like. Shorter ones are padded with samples of no duration.

    Args:
        index: which samples, ``[W, L]``; the last one again where there is none.
        measured: states, 0 where they were not measured, ``[W, L, n]``.
        mask: where they were, bool ``[W, L, n]``.
        time: seconds since the start of the window, ``[W, L]``.
        interval: seconds to the next sample, 0 in the padding, ``[W, L - 1]``.
    """

    index: Tensor  # type: ignore[assignment]
    measured: Tensor
    mask: Tensor
    time: Tensor
    interval: Tensor

    def take(self, rows: Tensor) -> Windows:
        """Some of the windows, by their numbers or a mask of them."""
        return Windows(*(part[rows] for part in tuple(self)))


def runs(samples: Samples, usable: Tensor) -> list[tuple[int, int]]:
    """Where usable samples of one recording follow one another, as (begin, end)."""
    label = torch.where(usable, samples.stretch, -1)
    edges = (label.diff() != 0).nonzero().flatten() + 1
    cuts = [0, *edges.tolist(), len(label)]
    return [(a, b) for a, b in pairwise(cuts) if label[a] >= 0]


def cut(spans: Sequence[tuple[int, int]], length: int, least: int) -> list[tuple[int, int]]:
    """Divide spans into equal ones of at most ``length``; those below ``least`` are left out.

    Examples:
        >>> cut([(0, 50), (60, 63)], length=20, least=5)
        [(0, 16), (16, 33), (33, 50)]
    """
    parts = []
    for begin, end in spans:
        count = -(-(end - begin) // length)
        edges = [begin + (end - begin) * i // count for i in range(count + 1)]
        parts += [(a, b) for a, b in pairwise(edges) if b - a >= least]
    return parts


def make_windows(samples: Samples, spans: Sequence[tuple[int, int]]) -> Windows:
    """The windows of spans of samples, each within one recording."""
    begin = torch.tensor([a for a, _ in spans], dtype=torch.long)[:, None]
    end = torch.tensor([b for _, b in spans], dtype=torch.long)[:, None]
    longest = max((b - a for a, b in spans), default=2)
    index = begin + torch.arange(longest)
    real = index < end
    index = torch.minimum(index, end - 1)
    measured = samples.state[index]
    mask = measured.isfinite() & real[..., None]
    time = samples.time[index] - samples.time[begin]
    return Windows(
        index, torch.where(mask, measured, torch.zeros_like(measured)), mask, time, time.diff(dim=1)
    )


def first_starts(system: System, windows: Windows, few: int = 9) -> Tensor:
    """Where each window might start, ``[W, n]``: parabolas through its first measurements.

    A velocity that is not measured starts at the slope of its position; another state that is not
    measured starts at zero.

    Args:
        system: says which velocity belongs to which position.
        windows: the windows.
        few: samples of a window that are looked at.
    """
    few = min(few, windows.mask.shape[1])
    value, slope = _parabolas(
        windows.time[:, :few], windows.measured[:, :few], windows.mask[:, :few]
    )
    starts = value
    index = system.state_names.index
    for position, velocity in system.velocity_of.items():
        unseen = ~windows.mask[:, :few, index(velocity)].any(1)
        starts[:, index(velocity)] = torch.where(
            unseen, slope[:, index(position)], starts[:, index(velocity)]
        )
    return starts


def _parabolas(time: Tensor, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Value and slope at time 0 of least-squares parabolas, ``[W, n]`` each.

    Where there are few measurements a little damping of the slope and, more so, of the bend turns
    them into lines and means.
    """
    scale = time.amax(1, keepdim=True).clamp_min(1e-12)
    t = time / scale
    basis = torch.stack([torch.ones_like(t), t, t.square()], -1)  # [W, few, 3]
    weighted = basis[:, :, None, :] * mask[..., None]  # [W, few, n, 3]
    matrix = torch.einsum("wtni,wtj->wnij", weighted, basis)
    right = torch.einsum("wtni,wtn->wni", weighted, values)
    damping = torch.tensor([1e-9, 1e-6, 1e-3], dtype=values.dtype)
    solution = torch.linalg.solve(matrix + damping.diag(), right)
    return solution[..., 0], solution[..., 1] / scale
