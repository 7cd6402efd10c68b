"""The path of the command and the integrator, chosen by error on windows that were not fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from phihp_torchrl.identification.choose_integrator import (
    choose_delay_and_integrator,
    choose_integrator,
)
from phihp_torchrl.identification.config import AUTO, IdentifyConfig
from phihp_torchrl.identification.each_action import (
    delay_each,
    in_words,
    is_fraction,
    lag_each,
    with_delays,
)
from phihp_torchrl.identification.model import NEUTRAL, Model, part_of
from phihp_torchrl.identification.parts import ActuatorTrial
from phihp_torchrl.identification.second_look import choose_again, near
from phihp_torchrl.identification.trials import Trial, Trials
from phihp_torchrl.identification.undecided import rivals
from phihp_torchrl.tasks import Actuator, Numbers

_PROMISING = 0.9
"""Share of the cost below which a part may be needed together with others."""
_ALIKE = 5.0
"""Ratio of the sizes of actions up to which they may be of one unit."""


def given_path(config: IdentifyConfig) -> Actuator:
    """The parts of the actuator that the settings give as numbers."""
    neutral = Actuator()
    numbers = {
        "delay_steps": config.delay,
        "lag": config.lag,
        "slew": config.slew or None,
        "dead_zone": config.dead_zone,
        "gain_low": config.gain_low,
    }
    return replace(neutral, **{n: v for n, v in numbers.items() if v not in (AUTO, None)})


class Chooser:
    """Tries paths of the command, from none to richer ones, and keeps what clearly helps.

    Args:
        trials: the windows.
        model: the equations, behind the given parts of the actuator.
        config: what is to be tried.
    """

    def __init__(self, trials: Trials, model: Model, config: IdentifyConfig) -> None:
        self.trials, self.config = trials, config
        self.best = trials.attempt("at once", model, model.first(), rounds=3)
        self.tried = [self.best]

    def choose_all(self) -> None:
        """Delay, lag, the other parts, and the integrator with its substeps, in this order.

        Where several actions move, each may have its own delay and lag. Unequal gains or a dead
        zone hide what is under way, so delay and lag are chosen anew behind such parts. A wrong
        integrator hides it too at long steps: delays are tried behind either, and where the other
        one is chosen in the end, all is chosen anew behind that.
        """
        first = self.best
        choose_delay_and_integrator(self)
        taken = self.best.model.integrator
        self._choose_after_delay()
        choose_integrator(self)
        found = self.best
        if found.model.integrator.name == taken.name:
            return
        model = replace(first.model, integrator=found.model.integrator)
        self.best = self.consider(f"{first.part}, {model.integrator.name}", model, found)
        self.choose_delay()
        self._choose_after_delay()
        if self.trials.better(found, self.best):
            self.best = found

    def _choose_after_delay(self) -> None:
        """All that a drive may do beside a common delay."""
        self._choose_path_after_delay()
        self.choose_slew()
        before = self.best
        promising = self.choose_parts()
        if promising is not before:
            choose_again(self, promising)

    def choose_path(self) -> None:
        """Delay and lag, of all actions together and then of each."""
        self.choose_delay()
        self._choose_path_after_delay()

    def _choose_path_after_delay(self) -> None:
        moving = self.moving()
        if len(moving) > 1 and self.config.delay == AUTO:
            delay_each(self, moving)
        self.choose_lag()
        if len(moving) > 1 and self.config.lag == AUTO:
            lag_each(self, moving)

    def consider(self, part: str, model: Model, like: Trial | None = None) -> Trial:
        """Try a model that starts from the constants of another trial, by default the best one."""
        like = like or self.best
        raw = model.first()
        raw[: model.constants] = like.raw[: model.constants]
        trial = self.trials.attempt(part, model, raw, like)
        self.tried.append(trial)
        return trial

    def consider_fraction(self, part: str, model: Model) -> None:
        """Try a model whose delay was added to what is fitted, and keep it if it is better.

        Near a whole number of steps, that number is fitted instead.
        """
        trial = self.consider(part, model)
        if not self.trials.better(trial, self.best):
            return
        *others, own = model.fitted
        found = model.number(model.actuator(trial.raw), own)
        if not is_fraction(found):
            path = trial.model.put(model.actuator(trial.raw), own, float(round(found)))
            whole = replace(model, fitted=tuple(others), path=path)
            label = f"delay {in_words(path.delay_steps)}"
            trial = self.consider(", ".join([label, *others]), whole, trial)
            if not self.lower(trial):
                return
        self.best = trial

    def choose_delay(self) -> None:
        """Whole delays first, and then a fraction if that is clearly better."""
        if self.config.delay != AUTO or not self._moves():
            return
        for delay in range(1, self.config.largest_delay + 1):
            model = with_delays(self.best.model, float(delay))
            trial = self.consider(f"delay {delay}", model)
            if self.trials.better(trial, self.best):
                self.best = trial
            elif delay > self.longest() + 1:
                break
        start = abs(self.longest() - 0.5)
        self.consider_fraction(
            "delay with a fraction", self.best.model.with_part("delay_steps", start)
        )

    def choose_lag(self) -> None:
        """A lag, with the delay that was found and with shorter ones, which it may explain."""
        if self.config.lag != AUTO or not self._moves():
            return
        base, delay = self.best, self.delay()
        shorter: list[Numbers] = [0.0, _changed(delay, lambda d: d // 2), _changed(delay, round)]
        shorter = [d for i, d in enumerate(shorter) if d not in shorter[:i]]
        for dead in shorter if self.config.delay == AUTO else [delay]:
            start = max(_longest(delay) - _longest(dead), 0.5) * self.trials.samples.step
            model = with_delays(self.best.model, dead).with_part("lag", start)
            late = _longest(dead) > 0
            trial = self.consider(f"delay {in_words(dead)}, lag" if late else "lag", model)
            instead = self.best is base and not late and _longest(delay) > 0  # one for another
            if self.lower(trial) if instead else self.trials.better(trial, self.best):
                self.best = trial
        if self.best is not base and self.config.delay == AUTO:
            near(self)

    def choose_slew(self) -> None:
        """A limit of the rate, behind the delay, or instead of a lag that stands for it."""
        rate = self._rate()
        if self.config.slew != AUTO or not rate or not self._alike():
            return
        lagging = any(part_of(name)[0] == "lag" for name in self.best.model.fitted)
        for share in (0.3, 0.05):
            model = with_delays(self.best.model, 0.0 if lagging else self.delay())
            trial = self.consider("slew", model.with_part("slew", share * rate))
            if self.lower(trial) if lagging else self.trials.better(trial, self.best):
                self.best, lagging = trial, False

    def choose_parts(self) -> Trial:
        """Unequal gains and a dead zone, of each action where several move.

        Returns:
            The best trial, or one that costs less, though not clearly: what else the drive does may
            hide that it is better.
        """
        promising = self.best
        action, moving = self.trials.samples.action, self.moving()
        each = list(moving) if len(moving) > 1 else [None] * len(moving)
        for part in ("gain_low", "dead_zone"):
            for i in each if getattr(self.config, part) == AUTO else ():
                column = action if i is None else action[:, i]
                if part == "gain_low" and not bool((column < 0).any()):
                    continue
                start = 0.9 if part == "gain_low" else 0.05 * float(column.abs().max())
                model = self.settled().with_part(part, start, i)
                trial = self.consider(f"{self.best.part}, {model.fitted[-1]}", model)
                if self.trials.better(trial, self.best):
                    self.best = promising = trial
                elif self._promises(trial, promising):
                    promising = trial
        return promising

    def _promises(self, trial: Trial, than: Trial) -> bool:
        cost = self.trials.cost
        return cost(trial, self.best) < _PROMISING * cost(than, self.best)

    def drop(self, name: str) -> None:
        """Leave out a fitted part that is not clearly needed."""
        model = self.settled()
        path = model.put(model.path, name, NEUTRAL[part_of(name)[0]])
        fitted = tuple(n for n in model.fitted if n != name)
        trial = self.consider(f"without {name}", replace(model, fitted=fitted, path=path))
        if not self.trials.better(self.best, trial):
            self.best = trial

    def settled(self) -> Model:
        """The best model, with its fitted parts as first guesses."""
        best = self.best
        return replace(best.model, path=best.model.actuator(best.raw))

    def table(self) -> tuple[ActuatorTrial, ...]:
        """Every trial, for the report."""
        rows, others = [], {id(trial) for trial in rivals(self)}
        for trial in self.tried:
            path = trial.model.actuator(trial.raw)
            cost = self.trials.cost(trial, self.best)
            kept, rival = trial is self.best, id(trial) in others
            rows.append(ActuatorTrial(trial.part, path.config, cost, kept, rival))
        return tuple(rows)

    def delay(self) -> Numbers:
        """The delay of the best model, for all actions or for each."""
        return self.best.model.actuator(self.best.raw).delay_steps

    def longest(self) -> float:
        """The longest delay of the best model."""
        return _longest(self.delay())

    def lower(self, trial: Trial) -> bool:
        """Whether a trial costs less than the best one, however little."""
        return self.trials.cost(trial, self.best) < self.trials.cost(self.best, self.best)

    def _moves(self) -> bool:
        """Whether any command ever changes."""
        return bool(self.moving())

    def moving(self) -> list[int]:
        """The actions whose commands change."""
        return (self.trials.samples.action.std(0) > 0).nonzero().flatten().tolist()

    def _alike(self) -> bool:
        """Whether the actions that move are about as large, so that one rate may limit them all."""
        sizes = self.trials.samples.action[:, self.moving()].std(0)
        return bool(sizes.max() <= _ALIKE * sizes.min())

    def _rate(self) -> float:
        samples = self.trials.samples
        rates = (samples.action.diff(dim=0).abs() / samples.interval[:-1, None]).flatten()
        moving = rates[rates > 0]
        return float(torch.quantile(moving, 0.9)) if len(moving) else 0.0


def _longest(delay: Numbers) -> float:
    return max(delay) if isinstance(delay, tuple) else delay


def _changed(delay: Numbers, change: Callable[[float], float]) -> Numbers:
    """The delay, or that of each action, changed."""
    if isinstance(delay, tuple):
        return tuple(float(change(d)) for d in delay)
    return float(change(delay))
