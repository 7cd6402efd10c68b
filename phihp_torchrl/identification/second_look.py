"""What is chosen anew once other parts of the path of a command are known."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from phihp_torchrl.identification.config import AUTO
from phihp_torchrl.identification.each_action import each, in_words, with_delays
from phihp_torchrl.identification.model import NEUTRAL, part_of
from phihp_torchrl.identification.trials import Trial
from phihp_torchrl.tasks import Numbers

if TYPE_CHECKING:
    from phihp_torchrl.identification.choices import Chooser


def near(chooser: Chooser) -> None:
    """Shift the delay beside a lag that was found, by whole steps and then by a fraction.

    A lag is tried behind few delays, of which the best may be a step off.
    """
    for direction in (1.0, -1.0):
        before = chooser.best
        while _shifted(chooser, direction):
            pass
        if chooser.best is not before:
            break
    delay = chooser.delay()
    if isinstance(delay, float):  # the same for all actions
        model = chooser.settled().with_part("delay_steps", abs(delay - 0.3))
        chooser.consider_fraction(f"delay with a fraction, {_others(chooser)}", model)


def _shifted(chooser: Chooser, direction: float) -> bool:
    """Whether a delay of a step more or less, with all else as it is, costs less; it stays then."""
    delays = each(chooser.delay(), len(chooser.best.model.actions))
    tried = [max(d + direction, 0.0) for d in delays]
    if max(tried) > chooser.config.largest_delay or tried == delays:
        return False
    delay: Numbers = tried[0] if len(set(tried)) == 1 else tuple(tried)
    model = chooser.settled()
    model = replace(model, path=replace(model.path, delay_steps=delay))
    trial = chooser.consider(f"delay {in_words(delay)}, {_others(chooser)}", model)
    if not chooser.lower(trial):
        return False
    chooser.best = trial
    return True


def choose_again(chooser: Chooser, promising: Trial) -> None:
    """Choose delay, lag and slew anew behind the other parts, and drop what is not needed then.

    A drive that pushes less to one side, of which the first choice knew nothing, looks late.

    Args:
        chooser: what tries models.
        promising: the trial whose parts are there from the start.
    """
    before, config = chooser.best, chooser.config
    chooser.best = promising
    delay = 0.0 if config.delay == AUTO else config.delay
    base = with_delays(chooser.settled(), delay)
    if config.delay == AUTO or config.lag == AUTO:
        chooser.best = chooser.consider(f"at once, {_others(chooser)}", base)
        chooser.choose_path()
        chooser.choose_slew()
    if chooser.best is not before and not _preferred(chooser, chooser.best, before):
        chooser.best = before
    for name in chooser.best.model.fitted:
        if part_of(name)[0] in NEUTRAL:
            chooser.drop(name)


def _preferred(chooser: Chooser, new: Trial, old: Trial) -> bool:
    """Whether a trial is better than another that may be richer or simpler."""
    more = len(new.model.fitted) - len(old.model.fitted)
    if more > 0:
        return chooser.trials.better(new, old)
    if more < 0:
        return not chooser.trials.better(old, new)
    return chooser.trials.cost(new, old) < chooser.trials.cost(old, old)


def _others(chooser: Chooser) -> str:
    """The parts that are fitted beside the delay."""
    return ", ".join(n for n in chooser.best.model.fitted if part_of(n)[0] != "delay_steps")
