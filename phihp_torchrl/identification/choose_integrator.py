"""The integrator and its substeps, chosen by error on windows that were not fitted."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from phihp_torchrl.identification.config import AUTO
from phihp_torchrl.identification.trials import Trial
from phihp_torchrl.integrators import make_integrator

if TYPE_CHECKING:
    from phihp_torchrl.identification.choices import Chooser


def choose_delay_and_integrator(chooser: Chooser) -> None:
    """A common delay behind Runge-Kutta's steps, or behind Euler's where those are clearly better.

    A step of Euler's acts half a step earlier than the motion that it stands for, so a delay that
    is sought behind the wrong one of the two is found wrong by as much.
    """
    first = chooser.best
    chooser.choose_delay()
    if chooser.config.integrator != AUTO:
        return
    found = chooser.best
    euler = make_integrator("semi_implicit_euler", substeps=chooser.config.substeps or 1)
    model = replace(first.model, integrator=euler)
    chooser.best = chooser.consider(f"{first.part}, {euler.name}", model, first)
    chooser.choose_delay()
    if not chooser.trials.better(chooser.best, found):
        chooser.best = found


def choose_integrator(chooser: Chooser) -> None:
    """Runge-Kutta with as few substeps as do; a step of Euler's where the data were made so."""
    config = chooser.config
    settings = [("rk4", 1), ("rk4", 2), ("rk4", 4), ("semi_implicit_euler", 1)]
    if config.substeps:
        settings = [("rk4", config.substeps), ("semi_implicit_euler", config.substeps)]
    elif config.integrator == "semi_implicit_euler":
        settings += [(config.integrator, 2), (config.integrator, 4)]
    settings = [s for s in settings if config.integrator in (AUTO, s[0])]
    chosen: Trial | None = None
    for name, substeps in settings:
        integrator = make_integrator(name, substeps=substeps)
        same = chooser.best.model.integrator
        trial = chooser.best
        if (name, substeps) != (same.name, same.settings["substeps"]):
            model = replace(chooser.best.model, integrator=integrator)
            label = f"{chooser.best.part}, {name} with {substeps} substeps"
            trial = chooser.trials.attempt(label, model, chooser.best.raw, chooser.best)
            chooser.tried.append(trial)
        if chosen is None or chooser.trials.better(trial, chosen):
            chosen = trial
        elif name == "rk4":
            settings = [s for s in settings if s[0] != "rk4"]
    assert chosen is not None
    chooser.best = chosen
