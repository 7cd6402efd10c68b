"""What acts on the system along a whole recording, given the commands and an actuator."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from phihp_torchrl.identification.windows import Samples
from phihp_torchrl.tasks import Actuator

_CHUNKS = 16, 64
"""Samples that one row of the scan yields, at least and at most: as many as it begins earlier."""
_FORGOTTEN = 16.0
"""Time constants after which a lag has forgotten what was before."""


def respond(samples: Samples, actuator: Actuator) -> Tensor:
    """The mean action during the interval after each sample, ``[N, m]``.

    The command before an episode is taken to be zero, as in the worlds of this package. Over a gap
    within an episode the last command is held. Behind a dead time alone all samples advance at
    once, for what waits are the commands before. A lag or a limit of the rate has a value of its
    own, but forgets: the recordings are cut into rows, each of which begins as much earlier as the
    actuator remembers, and all rows advance together.

    Args:
        samples: the recordings.
        actuator: what happens to a command.
    """
    if not actuator.config:
        return samples.action
    count, width = samples.action.shape
    lags = actuator.lag if isinstance(actuator.lag, tuple) else (actuator.lag,)
    if actuator.slew is None and not any(lags):
        return _waited(samples, actuator)
    before = memory(samples, actuator)
    chunk = min(max(before, _CHUNKS[0]), _CHUNKS[1])
    spans = _rows(samples, chunk)
    begin = torch.tensor([a for a, _ in spans])[:, None]
    first = samples.first[begin]
    index = begin + torch.arange(-before, chunk)
    known = index >= first
    index = index.clamp(0, count - 1)
    command = torch.where(known[..., None], samples.action[index], 0.0)
    seconds = torch.where(known, samples.interval[index], samples.step)
    registers = actuator.rest(command[:, 0])
    means = []
    for i in range(before + chunk):
        acting, registers = actuator.step(registers, command[:, i], seconds[:, i])
        if i >= before:
            means.append(acting)
    rows = torch.stack(means, 1)
    found = torch.empty(count, width, dtype=samples.action.dtype)
    for row, (a, b) in zip(rows, spans, strict=True):
        found[a:b] = row[: b - a]
    return found


def memory(samples: Samples, actuator: Actuator) -> int:
    """How many samples back a command still acts."""
    delay, lag = (
        value if isinstance(value, float) else max(value)
        for value in (actuator.delay_steps, actuator.lag)
    )
    seconds = _FORGOTTEN * lag
    if actuator.slew is not None:
        slew = actuator.slew if isinstance(actuator.slew, float) else min(actuator.slew)
        seconds += float(samples.action.amax() - samples.action.amin()) / slew
    steps = seconds / samples.step
    return min(math.ceil(delay) + math.ceil(steps) + 1, len(samples.action))


def _waited(samples: Samples, actuator: Actuator) -> Tensor:
    """What acts where nothing but commands is under way."""
    depth = actuator.registers(samples.action.shape[1]) // samples.action.shape[1]
    index = torch.arange(len(samples.time))[:, None] + torch.arange(-depth, 0)
    known = (index >= samples.first[:, None])[..., None]
    waiting = torch.where(known, samples.action[index.clamp_min(0)], 0.0).flatten(1)
    return actuator.step(waiting, samples.action, samples.interval)[0]


def _rows(samples: Samples, chunk: int) -> list[tuple[int, int]]:
    """Spans of at most ``chunk``, each within one episode, that cover all samples."""
    edges = [0, *((samples.first.diff() != 0).nonzero().flatten() + 1).tolist(), len(samples.first)]
    return [(at, min(at + chunk, b)) for a, b in pairwise(edges) for at in range(a, b, chunk)]
