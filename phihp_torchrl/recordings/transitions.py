"""Real transitions of recordings, in the form in which a world's environment gives them."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings.recording import Recording, check_columns
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)

_SLACK = 1e-4
"""By how much of its range a command may be beyond a bound, as rounding in a log does."""
_MOST = 0.5
"""Share of the transitions that may be left out for their commands. Spikes, a drive that is driven
by hand, or bounds that are narrower than the log's take some. A wrong unit takes all but those near
zero, and then a model of the few that are left would be nonsense that looks like a fit."""


def transitions(task: Task, recordings: Sequence[Recording]) -> TensorDict:
    """Return the transitions of recordings, with the time step of each.

    A transition is left out, and counted in the log, where a state is unknown before or after it,
    and where its command is beyond the bounds or the rate of the task, which a model would clip.
    The physics know of no reference: where the task has one, it stands in the middle of its range.
    Inputs are those of the recording; a preview has the samples that follow in the same recording,
    of which the last one is taken to stay.

    Args:
        task: the task, which says what was earned and where an episode ends.
        recordings: recordings in the units of the task's system.

    Returns:
        ``"observation"`` ``[N, o]``, ``"action"`` ``[N, m]``, ``"time_step"`` ``[N, 1]`` in seconds
        and, under ``"next"``, ``"observation"``, ``"reward"``, ``"terminated"`` and ``"done"``
        ``[N, 1]``, float32, in order. ``"done"`` marks the last transition before an interruption.

    Raises:
        ConfigError: for recordings of another system or without its inputs, a state that was never
            measured, commands of which most are beyond the bounds or the rate, and if nothing is
            left.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> time = torch.tensor([0.0, 0.05, 0.11])
        >>> log = Recording(time, torch.zeros(3, 2), torch.ones(3, 1))
        >>> data = transitions(get_task("pendulum"), [log])
        >>> data["time_step"].flatten().tolist(), data["next", "done"].flatten().tolist()
        ([0.05000000074505806, 0.05999999865889549], [False, True])
    """
    _check(task, recordings)
    left: Counter[str] = Counter()
    parts = [
        part
        for log, before in zip(recordings, (None, *recordings), strict=False)
        if len(part := _of(task, log, _goes_on(log, before), left))
    ]
    _check_commands(task, recordings, left, sum(map(len, parts)))
    for reason, count in left.items():
        _log.warning("%d recorded transitions are left out: %s.", count, reason)
    if not parts:
        raise ConfigError("recordings", f"no transition can be used: {dict(left)}.")
    return torch.cat(parts)


def _states(task: Task, recording: Recording) -> Tensor:
    """The task's state at each sample, float64 ``[T, n]``.

    This is the only place where a sample of a log becomes a state: what a task adds to the physical
    one, from the commands so far and the measured inputs, belongs here.
    """
    if not task.register_count:
        return recording.state
    held = torch.cat([recording.intervals, recording.intervals[-1:]])
    commands = task.clip_action(recording.action)
    rest = task.clip_action(torch.zeros_like(commands[0]))
    _, registers = task.registers.along(commands, held, rest)
    if task.inputs is not None:
        last = len(recording) - 1
        known = torch.arange(last + 1)[:, None] + torch.arange(task.inputs.rows)
        given = {"inputs": recording.inputs[known.clamp_max(last)]}  # [T, rows, k]
        own = task.outside.read(given, registers[:, : task.outside.size])
        registers = task.outside.replaced(registers, own)
    return torch.cat([recording.state, registers], -1)


def _check(task: Task, recordings: Sequence[Recording]) -> None:
    names = task.system.state_names
    check_columns(task.system, recordings)
    measured = torch.stack([log.measured for log in recordings]).any(0) if recordings else ()
    if missing := [n for n, known in zip(names, measured, strict=False) if not known]:
        raise ConfigError(
            "recordings",
            f"expected a measured {missing[0]!r}, it is in no recording; name its column, or use "
            "estimate_velocities for a velocity.",
        )


def _check_commands(
    task: Task, recordings: Sequence[Recording], left: Counter[str], used: int
) -> None:
    """Refuse recordings most of whose commands the task does not allow."""
    beyond, faster = left[_beyond(task)], left[_faster(task)]
    usable = used + beyond + faster
    if beyond + faster <= _MOST * usable:
        return
    given = torch.cat([log.action for log in recordings])
    rates = torch.cat([log.action.diff(dim=0).abs() / log.intervals[:, None] for log in recordings])
    sizes = (x.tolist() for x in (given.amin(0), given.amax(0), rates.amax(0)))
    ranges = ", ".join(
        f"{name} from {low:.4g} to {high:.4g} that changes by up to {rate:.4g} a second"
        for name, low, high, rate in zip(task.system.action_names, *sizes, strict=True)
    )
    reasons = [r for r, count in ((_beyond(task), beyond), (_faster(task), faster)) if count]
    raise ConfigError(
        "recordings",
        f"{beyond + faster} of {usable} transitions would be left out: {'. Or '.join(reasons)}. "
        f"The recordings have {ranges}.",
    )


def _beyond(task: Task) -> str:
    return (
        f"their commands are beyond the bounds of task {task.name!r}, {task.action_low} to "
        f"{task.action_high}; check the unit and scale of the column, or widen those in "
        "Task(action_low=..., action_high=...)"
    )


def _faster(task: Task) -> str:
    return (
        f"their commands change faster than the action_rate_limit of task {task.name!r}, "
        f"{task.action_rate_limit}; check the unit and scale of the column, or raise that limit"
    )


def _goes_on(log: Recording, before: Recording | None) -> bool:
    """Whether a stretch starts in the middle of an episode."""
    return (
        before is not None and log.episode == before.episode and bool(log.time[0] > before.time[-1])
    )


def _of(task: Task, log: Recording, goes_on: bool, left: Counter[str]) -> TensorDict:
    """The transitions of a stretch; one that goes on starts in the middle of an episode."""
    state, action = _states(task, log), log.action[:-1]
    observation = task.observe(state)
    low = log.action.new_tensor(task.action_low or ())
    high = log.action.new_tensor(task.action_high)
    slack = _SLACK * (high - low)
    outside = ((action < low - slack) | (action > high + slack)).any(-1)
    known = observation.isfinite().all(-1)
    unknown = ~(known[:-1] & known[1:])
    left["a state is unknown before or after them"] += int(unknown.sum())
    if goes_on and task.register_count:
        early = log.time[:-1] < log.time[0] + task.registers.memory(task.time_step)
        left["what was under way before their stretch is unknown"] += int((early & ~unknown).sum())
        unknown |= early
    left[_beyond(task)] += int((outside & ~unknown).sum())
    outside |= (fast := _too_fast(task, observation[:-1], action, log.intervals) & ~outside)
    left[_faster(task)] += int((fast & ~unknown).sum())
    left -= Counter()  # drops the zeros
    use = ~(unknown | outside)
    at = use.nonzero()[:, 0]
    before, after = state[:-1][use].float(), state[1:][use].float()
    done = torch.ones(len(at), 1, dtype=torch.bool)
    done[:-1, 0] = at.diff() > 1
    command = task.clip_action(action[use].float())
    reward = task.earned(before, command, after)
    return TensorDict(
        observation=observation[:-1][use].float(),
        action=command,
        time_step=log.intervals[use].float()[:, None],
        next=TensorDict(
            observation=observation[1:][use].float(),
            reward=reward[:, None],
            done=done,
            terminated=task.is_terminated(after, command)[:, None],
            batch_size=[len(at)],
        ),
        batch_size=[len(at)],
    )


def _too_fast(task: Task, observation: Tensor, action: Tensor, intervals: Tensor) -> Tensor:
    """Whether a command of a log is beyond the rate that the task allows, bool ``[T]``."""
    if task.action_rate_limit is None:
        return torch.zeros(len(action), dtype=torch.bool)
    registers = task.split(task.locate(observation))[1]
    clipped = task.clip_action(action)
    commands = task.registers.command(registers, clipped, intervals)
    slack = _SLACK * task.bounds.scale.to(action)
    return ((clipped - commands).abs() > slack).any(-1)
