"""A dead time and a lag for each action, where one for all does not explain the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from phihp_torchrl.identification.model import Model, part_of
from phihp_torchrl.tasks import Numbers

if TYPE_CHECKING:
    from phihp_torchrl.identification.choices import Chooser

_WHOLE = 0.1
"""A delay this near to a whole number of steps is taken to be one."""


def is_fraction(delay: float) -> bool:
    """Whether a delay is far from any whole number of steps."""
    return abs(delay - round(delay)) > _WHOLE


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
        model = replace(chooser.best.model, path=chooser.settled().path)
        own = f"delay_steps of {names[i]}"
        if own in model.fitted or "delay_steps" in model.fitted:
            continue
        start = abs(each(chooser.delay(), len(names))[i] - 0.4)
        fraction = model.with_part("delay_steps", start, i)
        chooser.consider_fraction(f"delay of {names[i]} with a fraction", fraction)


def lag_each(chooser: Chooser, moving: Sequence[int]) -> None:
    """Give each action a lag of its own, and the delay beside it, where that is clearly better.

    Args:
        chooser: what tries models; its best one is the first guess.
        moving: the actions whose commands change.
    """
    names = chooser.best.model.actions
    if "lag" in chooser.best.model.fitted:
        _lag_apart(chooser, moving)
    for i in moving:
        if any(n in ("lag", f"lag of {names[i]}") for n in chooser.best.model.fitted):
            continue
        base = chooser.best
        delay = each(chooser.delay(), len(names))[i]
        found = None
        for dead in range(math.ceil(delay), -1, -1):
            start = max(delay - dead, 0.5) * chooser.trials.samples.step
            model = _with_own(chooser, i, float(dead)).with_part("lag", start, i)
            trial = chooser.consider(f"lag of {names[i]} behind a delay of {dead}", model)
            if found is None or chooser.trials.cost(trial, base) < chooser.trials.cost(found, base):
                found = trial
        if found is not None and chooser.trials.better(found, chooser.best):
            chooser.best = found


def _lag_apart(chooser: Chooser, moving: Sequence[int]) -> None:
    """Split a lag of all actions, and leave out that of an action that needs none."""
    names = chooser.best.model.actions
    model = chooser.settled()
    fitted = tuple(n for n in model.fitted if n != "lag")
    start = model.path.lag
    apart = replace(model, fitted=fitted)
    for i in moving:
        apart = apart.with_part("lag", each(start, len(names))[i], i)
    trial = chooser.consider("a lag for each action", apart)
    if not chooser.trials.better(trial, chooser.best):
        return
    chooser.best = trial
    for i in moving:
        chooser.drop(f"lag of {names[i]}")


def _with_own(chooser: Chooser, i: int, delay: float) -> Model:
    """The best model with another delay of one action, which is not fitted."""
    model = chooser.settled()
    own = f"delay_steps of {model.actions[i]}"
    delays = each(model.path.delay_steps, len(model.actions))
    delays[i] = delay
    fitted = tuple(n for n in model.fitted if n not in (own, "delay_steps"))
    return replace(model, fitted=fitted, path=replace(model.path, delay_steps=tuple(delays)))
