"""Paths of the command that the recordings do not tell from the one that was kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from phihp_torchrl.identification.each_action import each
from phihp_torchrl.identification.parts import ActuatorTrial, Finding
from phihp_torchrl.identification.trials import Trial

if TYPE_CHECKING:
    from phihp_torchrl.identification.choices import Chooser

_APART = 0.75
"""Steps by which a command acts earlier or later that make another path of it."""


def rivals(chooser: Chooser) -> list[Trial]:
    """Trials that are late by other times than the best one, and not clearly worse.

    A limit of the rate may be too high to do anything, so such trials are no rivals.
    """
    best = chooser.best
    if chooser.trials.is_exact(chooser.trials.noise(best)):
        own = [t for t in chooser.tried if chooser.trials.is_exact(chooser.trials.noise(t))]
    else:
        own = [t for t in chooser.tried if not chooser.trials.better(best, t)]
    kept = _lateness(chooser, best)
    return [
        trial
        for trial in own
        if "slew" not in trial.model.fitted
        and any(abs(a - b) > _APART for a, b in zip(kept, _lateness(chooser, trial), strict=True))
    ]


def _lateness(chooser: Chooser, trial: Trial) -> list[float]:
    """Dead time and lag together of each action, in steps."""
    path, count = trial.model.actuator(trial.raw), len(trial.model.actions)
    step = chooser.trials.samples.step
    delays, lags = each(path.delay_steps, count), each(path.lag, count)
    return [delay + lag / step for delay, lag in zip(delays, lags, strict=True)]


def of_path(tried: Sequence[ActuatorTrial]) -> list[Finding]:
    """A warning where other paths of the command explain the recordings about as well.

    Examples:
        >>> tried = [ActuatorTrial("at once", {}, 0.85, kept=True)]
        >>> late = ActuatorTrial("delay 2", {"delay_steps": 2.0}, 0.83, rival=True)
        >>> of_path([*tried, late])[0].text
        'How late commands act is undecided: at once was kept, but delay 2 fits about as well.'
        >>> of_path(tried)
        []
    """
    others = [trial for trial in tried if trial.rival]
    if not others:
        return []
    kept = next(trial.part for trial in tried if trial.kept)
    nearest = min(others, key=lambda trial: trial.cost)
    more = len({trial.part for trial in others}) - 1
    also = f" (and {more} more)" if more else ""
    return [
        Finding(
            "undecided",
            f"How late commands act is undecided: {kept} was kept, but {nearest.part}{also} fits "
            "about as well.",
            "Record longer, with commands that change often and far, or give the path of the "
            "command with identify.delay and identify.lag. Until then see how far the constants "
            "move with either.",
        )
    ]
