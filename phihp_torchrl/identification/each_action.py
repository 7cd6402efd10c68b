"""A dead time for each action, where one for all of them does not explain the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from phihp_torchrl.identification.model import Model, part_of
from phihp_torchrl.tasks import Numbers

if TYPE_CHECKING:
    from phihp_torchrl.identification.choices import Chooser


def each(value: Numbers, count: int) -> list[float]:
    """The numbers of ``count`` actions."""
    return list(value) if isinstance(value, tuple) else [value] * count


def in_words(value: Numbers) -> str:
    """One number, or one for each action.

    Examples:
        >>> in_words(2.0), in_words((0.0, 2.0))
        ('2', '0 and 2')
    """
    return " and ".join(f"{v:g}" for v in (value if isinstance(value, tuple) else (value,)))


def with_delays(model: Model, delays: Sequence[float] | float) -> Model:
    """A model with other delays, which are not fitted, and without a lag that was."""
    kept = tuple(name for name in model.fitted if part_of(name)[0] not in ("delay_steps", "lag"))
    had_lag = any(part_of(name)[0] == "lag" for name in model.fitted)
    delay = float(delays) if isinstance(delays, (int, float)) else tuple(delays)
    free = {"delay_steps": delay, **({"lag": 0.0} if had_lag else {})}
    return replace(model, fitted=kept, path=replace(model.path, **free))


def delay_each(chooser: Chooser, moving: Sequence[int]) -> None:
    """Change the delay of one action after the other, where that is clearly better.

    Args:
        chooser: what tries models; its best one is the first guess.
        moving: the actions whose commands change.
    """
    names = chooser.best.model.actions
    for i in moving:
        for direction in (1, -1):
            delays = each(chooser.delay(), len(names))
            begin = best = delays[i]
            # One step may not help where two do.
            for ahead in range(1, chooser.config.largest_delay + 1):
                delays[i] = begin + direction * ahead
                near = abs(delays[i] - best) <= 2.0
                if not near or not 0.0 <= delays[i] <= chooser.config.largest_delay:
                    break
                label = f"delay {delays[i]:g} of {names[i]}"
                trial = chooser.consider(label, with_delays(chooser.best.model, delays))
                if chooser.trials.better(trial, chooser.best):
                    chooser.best, best = trial, delays[i]
            if best != begin:
                break
