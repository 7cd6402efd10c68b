"""Whether commands of a real world act late, where nobody has said that they do."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from tensordict import TensorDict

from phihp_torchrl.config import override_lines
from phihp_torchrl.dynamics import (
    DynamicsLoss,
    FitConfig,
    choose_actuator,
    explained_by_commands,
    with_registers,
)
from phihp_torchrl.recordings import transitions
from phihp_torchrl.tasks import Actuator, Task
from phihp_torchrl.worlds import World

DOING = "looking for a delay of commands"
"""What a run says that it is doing while this is on its stack."""

_log = logging.getLogger(__name__)

AUTO, NONE = "auto", "none"
CHOICES = (AUTO, NONE)
"""Whether phase 1 chooses an actuator for a task without one."""
_EXPLAINED = 0.1
"""Share of the errors from which on commands before are held to be under way."""
_EXACT = 1e-5
"""A held-out error at which nothing is asked: 0.3 % of a step's change."""
_MORE = 2.0
"""How many times as many transitions there must be before actuators are tried again."""
_DIGITS = 3


class Found(NamedTuple):
    """An actuator, and the transitions of a task that has it."""

    actuator: Actuator
    data: TensorDict


class Lateness:
    """Looks whether previous commands explain what a model leaves over, and finds an actuator.

    Args:
        task: the task.
        world: the real world.
        wanted: ``"auto"``, or ``"none"`` to look for nothing.
        fit: how the model is fitted. Adam is too slow for trials, and there is a warning instead.
    """

    def __init__(self, task: Task, world: World, wanted: str, fit: FitConfig) -> None:
        self.world, self.fit = world, fit
        self.open = wanted == AUTO and task.actuator is None
        """Whether an actuator may be chosen still."""
        self._told, self._tried = False, 0  # transitions of the last trials

    def suspected(self, loss: DynamicsLoss, data: TensorDict, held_out_error: float) -> bool:
        """Whether previous commands explain errors of the fitted model."""
        if not self.open or held_out_error < _EXACT or len(data) < _MORE * self._tried:
            return False
        shares = explained_by_commands(loss, data)
        name = max(shares, key=shares.__getitem__, default="")
        if not name or shares[name] < _EXPLAINED:
            return False
        if self.fit.method == "adam" and not self._told:
            self._told = True
            _log.warning(
                "The commands before explain %.0f %% of the model's errors in %s, as where "
                "commands act late: give the task the dead time or the lag of its actuator "
                "(actuator.delay_steps=1, actuator.lag=0.05), or choose another fit.method, with "
                "which they are found.",
                100.0 * shares[name],
                name,
            )
        return self.fit.method != "adam"

    def find(
        self,
        loss: DynamicsLoss,
        data: TensorDict,
        generator: torch.Generator,
        begin_again: Callable[[], None],
    ) -> Found | None:
        """The actuator behind which the model predicts clearly better, told in one line.

        Args:
            loss: the loss of the fitted model, which stays fitted where nothing is found.
            data: all transitions.
            generator: source of mini-batches.
            begin_again: gives the model its first parameters.
        """
        task, fitted = loss.dynamics.task, copy.deepcopy(loss.state_dict())
        self._tried = len(data)

        def data_for(actuator: Actuator) -> TensorDict:
            return self._data(replace(task, actuator=actuator), data)

        begin_again()
        trials = choose_actuator(loss, data_for, self.fit, generator)
        best, plain = trials[0], next(t for t in trials if not t.actuator.config)
        if best is plain:
            loss.load_state_dict(fitted)
            self._tell_nothing()
            return None
        actuator = rounded(best.actuator)
        _log.warning(
            "Commands act late in %s: %s is taken for the task's actuator, by imagination, plans "
            "and the agent too (the error of a held-out step falls from %.3g to %.3g of its "
            "change). Say it from the start with %s, or keep it off with model.actuator=none.",
            self.world,
            _words(actuator),
            plain.error,
            best.error,
            " ".join(override_lines({f"actuator.{k}": v for k, v in actuator.config.items()})),
        )
        found = data_for(actuator)
        known = found.pop("known", torch.ones(len(found), dtype=torch.bool))
        return Found(actuator, found[known].exclude("step_count"))

    def _data(self, task: Task, data: TensorDict) -> TensorDict:
        """Transitions of a task without an actuator as those of ``task``, with ``"known"`` rows."""
        if not task.register_count:
            return data
        if self.world.recordings is not None:
            found = transitions(task, self.world.recordings)
            if "time_step" not in data.keys():  # noqa: SIM118 (a tensordict, no dictionary)
                del found["time_step"]
            return found
        found, known = with_registers(task, data)
        return found.set("known", known)

    def _tell_nothing(self) -> None:
        if not self._told:
            self._told = True
            _log.warning(
                "The commands before explain errors of the model, but no dead time or lag of up "
                "to 5 steps does, the same for every action. A limit of the rate, a dead zone, "
                "backlash, or actions that are late by different times may: say it "
                "(actuator.slew=..., actuator.dead_zone=..., actuator.delay_steps=[0,2]), or let "
                "`phihp identify` look for it, action by action."
            )


def rounded(actuator: Actuator) -> Actuator:
    """The actuator with as many digits as a search can tell.

    Examples:
        >>> rounded(Actuator(delay_steps=2.0, lag=0.0412345)).lag
        0.0412
    """
    numbers = {k: float(f"{v:.{_DIGITS}g}") for k, v in actuator.config.items()}
    return replace(actuator, **numbers)


def _words(actuator: Actuator) -> str:
    parts = {"a dead time of {:.3g} steps": actuator.delay_steps, "a lag of {:.3g} s": actuator.lag}
    return " with ".join(text.format(value) for text, value in parts.items() if value)
