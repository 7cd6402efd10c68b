"""The path of the command and the integrator, chosen by error on windows that were not fitted."""

from __future__ import annotations

from dataclasses import replace

import torch

from phihp_torchrl.identification.config import AUTO, IdentifyConfig
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.parts import ActuatorTrial
from phihp_torchrl.identification.trials import Trial, Trials
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.tasks import Actuator

_WHOLE = 0.1
"""A delay this near to a whole number of steps is taken to be one."""


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
        """Delay, lag, the other parts, and the integrator, in this order."""
        self.choose_delay()
        self.choose_lag()
        self.choose_slew()
        self.choose_parts()
        self.choose_integrator()

    def _consider(self, part: str, model: Model) -> Trial:
        """Try a model that starts from the constants of the best one."""
        raw = model.first()
        raw[: model.constants] = self.best.raw[: model.constants]
        trial = self.trials.attempt(part, model, raw, self.best)
        self.tried.append(trial)
        return trial

    def choose_delay(self) -> None:
        """Whole delays first, and then a fraction if that is clearly better."""
        if self.config.delay != AUTO or not self._moves():
            return
        for delay in range(1, self.config.largest_delay + 1):
            model = self._with_delay(float(delay))
            trial = self._consider(f"delay {delay}", model)
            if self.trials.better(trial, self.best):
                self.best = trial
            elif delay > self._delay() + 1:
                break
        start = abs(self._delay() - 0.5)
        trial = self._consider(
            "delay with a fraction", self.best.model.with_part("delay_steps", start)
        )
        found = trial.raw[-1].item()
        if abs(found - round(found)) > _WHOLE and self.trials.better(trial, self.best):
            self.best = trial

    def choose_lag(self) -> None:
        """A lag, with the delay that was found and with shorter ones, which it may explain."""
        if self.config.lag != AUTO or not self._moves():
            return
        base, delay = self.best, self._delay()
        shorter = {0.0, float(int(delay) // 2), float(round(delay))}
        for dead in sorted(shorter) if self.config.delay == AUTO else [delay]:
            start = max(delay - dead, 0.5) * self.trials.samples.step
            model = self._with_delay(dead).with_part("lag", start)
            trial = self._consider(f"delay {dead:g}, lag" if dead else "lag", model)
            instead = self.best is base and not dead and delay > 0  # one number for another
            if self._lower(trial) if instead else self.trials.better(trial, self.best):
                self.best = trial

    def _with_delay(self, delay: float) -> Model:
        """The best model with another delay, which is not fitted."""
        model = self.best.model
        fitted = tuple(part for part in model.fitted if part not in ("delay_steps", "lag"))
        free = {"delay_steps": delay, **({"lag": 0.0} if "lag" in model.fitted else {})}
        return replace(model, fitted=fitted, path=replace(model.path, **free))

    def choose_slew(self) -> None:
        """A limit of the rate, behind the delay, or instead of a lag that stands for it."""
        rate = self._rate()
        if self.config.slew != AUTO or not rate:
            return
        lagging = "lag" in self.best.model.fitted
        for share in (0.3, 0.05):
            model = self._with_delay(0.0 if lagging else self._delay())
            trial = self._consider("slew", model.with_part("slew", share * rate))
            if self._lower(trial) if lagging else self.trials.better(trial, self.best):
                self.best, lagging = trial, False

    def choose_parts(self) -> None:
        """Unequal gains and a dead zone."""
        action = self.trials.samples.action
        size = float(action.abs().max())
        first = {"gain_low": 0.9, "dead_zone": 0.05 * size}
        for part, start in first.items():
            possible = start > 0 and (part != "gain_low" or bool((action < 0).any()))
            if getattr(self.config, part) != AUTO or not possible or not self._moves():
                continue
            model = self.settled().with_part(part, start)
            trial = self._consider(f"{self.best.part}, {part}", model)
            if self.trials.better(trial, self.best):
                self.best = trial

    def choose_integrator(self) -> None:
        """Runge-Kutta with as few substeps as do; a step of Euler's where the data were made so."""
        config = self.config
        settings = [("rk4", 1), ("rk4", 2), ("rk4", 4), ("semi_implicit_euler", 1)]
        if config.substeps:
            settings = [("rk4", config.substeps), ("semi_implicit_euler", config.substeps)]
        elif config.integrator == "semi_implicit_euler":
            settings += [(config.integrator, 2), (config.integrator, 4)]
        settings = [s for s in settings if config.integrator in (AUTO, s[0])]
        chosen: Trial | None = None
        for name, substeps in settings:
            integrator = make_integrator(name, substeps=substeps)
            same = self.best.model.integrator
            trial = self.best
            if (name, substeps) != (same.name, same.settings["substeps"]):
                model = replace(self.best.model, integrator=integrator)
                label = f"{self.best.part}, {name} with {substeps} substeps"
                trial = self.trials.attempt(label, model, self.best.raw, self.best)
                self.tried.append(trial)
            if chosen is None or self.trials.better(trial, chosen):
                chosen = trial
            elif name == "rk4":
                settings = [s for s in settings if s[0] != "rk4"]
        assert chosen is not None
        self.best = chosen

    def settled(self) -> Model:
        """The best model, with its fitted parts as first guesses."""
        best = self.best
        return replace(best.model, path=best.model.actuator(best.raw))

    def table(self) -> tuple[ActuatorTrial, ...]:
        """Every trial, for the report."""
        rows = []
        for trial in self.tried:
            path = trial.model.actuator(trial.raw)
            values = {name: float(value) for name, value in path.config.items()}
            cost = self.trials.cost(trial, self.best)
            rows.append(ActuatorTrial(trial.part, values, cost, trial is self.best))
        return tuple(rows)

    def _delay(self) -> float:
        return float(self.best.model.actuator(self.best.raw).delay_steps)  # type: ignore[arg-type]

    def _lower(self, trial: Trial) -> bool:
        return self.trials.cost(trial, self.best) < self.trials.cost(self.best, self.best)

    def _moves(self) -> bool:
        """Whether any command ever changes."""
        return bool((self.trials.samples.action.std(0) > 0).any())

    def _rate(self) -> float:
        samples = self.trials.samples
        rates = (samples.action.diff(dim=0).abs() / samples.interval[:-1, None]).flatten()
        moving = rates[rates > 0]
        return float(torch.quantile(moving, 0.9)) if len(moving) else 0.0
