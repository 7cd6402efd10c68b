"""The choice of a task's actuator by the held-out error of its model: dead time and lag."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.fitting import fit
from phihp_torchrl.dynamics.held_out import BLOCK
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.ranks import signed_rank
from phihp_torchrl.dynamics.solver_choice import draws_of, set_draws
from phihp_torchrl.dynamics.under_way import episodes
from phihp_torchrl.tasks import Actuator

BEFORE = 5
"""How many previous commands are looked at, and the longest dead time that is tried, in steps."""
_ROWS = 20
"""Transitions that a regression needs for each of its columns."""
_FAR = 5.0
"""Robust standard deviations at which an error is cut off, as those of stops and outliers are."""
_SMALL = 1e-3
"""Share of the largest mean squared error below which a component's is not looked at."""
_HELD = 3
"""One block of transitions in so many is held out of a trial."""
_TRIAL_STEPS, _NEAR_STEPS = 15, 6
"""Optimization steps of a trial, and of one that starts from the best so far."""
_CLEAR = 3.0
"""Standard errors by which held-out errors must be smaller, by their ranks."""
_WORTH = 0.95
"""A richer actuator must bring the mean held-out error below this share of a simpler one's."""
_GOOD = 3e-3
"""A mean held-out error at which nothing richer is tried: 0.3 % of a step's change."""
_LAGS = (0.3, 1.0, 3.0)
"""First lags that are tried, in steps."""
_NARROW = 6
"""Trials that narrow a lag or a fraction down, to about a tenth of where they begin."""


@dataclass(frozen=True, eq=False)
class ActuatorTrial:
    """A fit with one actuator.

    Args:
        actuator: what happens to a command.
        errors: size of the error of each held-out transition in units of a step's change, ``[M]``;
            NaN where it is not known what was under way.
        state: the fitted parameters.
    """

    actuator: Actuator
    errors: Tensor
    state: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def error(self) -> float:
        """Mean size of the errors."""
        return self.errors.nanmean().item()

    def clearly_better(self, other: ActuatorTrial) -> bool:
        """Whether held-out errors are smaller than those of a simpler actuator beyond chance."""
        if not self.error < _WORTH * other.error:
            return False
        if len(self.errors) != len(other.errors):  # other rows are known, which cannot be paired
            return True
        gain = other.errors - self.errors
        return signed_rank(gain[gain.isfinite()]) >= _CLEAR


@torch.no_grad()
def explained_by_commands(loss: DynamicsLoss, data: TensorDictBase) -> dict[str, float]:
    """Share of the model's one-step errors that the commands before explain, by state.

    What acts at once has no memory, so commands before a step add nothing to what its state and its
    own command tell, unless they are still under way. Errors and previous commands are compared
    with all that is linear in the observation and the command taken away from both, because
    friction too goes with commands before, by way of the velocity that they caused.

    Args:
        loss: the loss of the fitted model.
        data: transitions ``[N]`` in the order of time, with ``"done"`` under ``"next"``.

    Returns:
        By name of each state with an error that counts, the share in [0, 1], adjusted for the
        number of columns; empty for too few transitions.
    """
    rows = _after_others(data)
    columns = BEFORE * data["action"].shape[-1]
    if len(rows) < _ROWS * columns:
        return {}
    terms = loss.transitions(data)
    seconds = loss.time_step(data)
    error = (loss.prediction_error(*terms, seconds) / loss.error_scale)[rows].double()
    own = torch.cat([data["observation"], data["action"]], -1)[rows].double()
    own = torch.cat([torch.ones_like(own[:, :1]), own], -1)
    before = torch.cat([data["action"][rows - k] for k in range(1, BEFORE + 1)], -1).double()
    spread = error.abs().median(0).values.clamp_min(1e-12) / 0.6745
    error = error.clamp(-_FAR * spread, _FAR * spread)
    power = error.square().mean(0)
    error, before = _without(own, error), _without(own, before)
    left = _without(before, error)
    freedom = len(rows) - own.shape[1]
    ratio = left.square().sum(0) / error.square().sum(0).clamp_min(1e-300)
    share = 1.0 - ratio * freedom / (freedom - columns)
    names = loss.dynamics.task.system.state_names
    return {
        name: max(value, 0.0)
        for name, value, size in zip(names, share.tolist(), power.tolist(), strict=True)
        if size > _SMALL * float(power.max())
    }


def choose_actuator(
    loss: DynamicsLoss,
    data_for: Callable[[Actuator], TensorDictBase],
    config: FitConfig,
    generator: torch.Generator | None = None,
) -> list[ActuatorTrial]:
    """Fit the model behind actuators from none to richer ones, and find the one that predicts best.

    Dead times of whole steps come first, then a lag behind shorter ones, which it may explain, and
    then a fraction of a step. A richer actuator is taken only if held-out errors are clearly
    smaller. Every fit starts from the parameters that the loss has now and draws the same numbers;
    afterwards the loss and its task are as before.

    Args:
        loss: the loss of the model, with parameters from which a fit may start.
        data_for: the transitions of the model's task with an actuator, in the order of time.
        config: method and hyper-parameters of the fits.
        generator: source of mini-batches. Defaults to torch's global generator.

    Returns:
        The trials, the best one first and then the others in order; the first may be that of an
        actuator that does nothing.
    """
    search = _Search(loss, data_for, config, generator)
    best = search.run()
    return [best, *(trial for trial in search.trials if trial is not best)]


class _Search:
    """The trials so far, and the best of them."""

    def __init__(
        self,
        loss: DynamicsLoss,
        data_for: Callable[[Actuator], TensorDictBase],
        config: FitConfig,
        generator: torch.Generator | None,
    ) -> None:
        self.loss, self.data_for, self.generator = loss, data_for, generator
        # Multiple shooting has no use for an actuator that one-step errors, cheaper, rule out.
        steps = min(config.steps, _TRIAL_STEPS)
        self.config = replace(config, method="levenberg_marquardt", steps=steps)
        self.start, self.draws = copy.deepcopy(loss.state_dict()), draws_of(generator)
        self.begin = self.start
        self.task = loss.dynamics.task
        self.trials: list[ActuatorTrial] = []

    def run(self) -> ActuatorTrial:
        """Try forms of an actuator, the simple ones first, and keep what is clearly better."""
        plain = self._attempt(Actuator())
        delayed = self._delays()
        # What is tried now differs little from the best so far, and starts from it.
        config, self.begin = self.config, _lowest([plain, delayed]).state
        steps, lambda_ = min(config.steps, _NEAR_STEPS), config.final_lambda
        self.config = replace(config, steps=steps, initial_lambda=lambda_)
        one, two = [delayed], []
        if delayed.error > _GOOD:
            delay = _delay(delayed)
            one.append(self._lag(0.0))
            two = [self._lag(dead) for dead in (delay - 1.0, delay) if dead > 0.0]
            if _lowest([*one, *two]).error > _GOOD:
                two.append(self._fraction(delay))
        self.begin = self.start
        self._reset()
        self.loss.dynamics.task = self.task
        best = plain
        for trials in (one, two):  # of one number, and of two
            if trials and (trial := _lowest(trials)).clearly_better(best):
                best = trial
        return best

    def _reset(self) -> None:
        self.loss.load_state_dict(self.begin)
        set_draws(self.generator, self.draws)

    def _attempt(self, actuator: Actuator) -> ActuatorTrial:
        self._reset()
        loss, data = self.loss, self.data_for(actuator)
        loss.dynamics.task = replace(self.task, actuator=actuator if actuator.config else None)
        held = torch.arange(len(data)) // BLOCK % _HELD == _HELD - 1
        known = data.get("known", torch.ones(len(data), dtype=torch.bool))
        fit(loss, data[~held & known], data[held & known], self.config, self.generator)
        with torch.no_grad():
            terms, seconds = loss.transitions(data[held]), loss.time_step(data[held])
            error = loss.prediction_error(*terms, seconds) / loss.error_scale
        sizes = torch.where(known[held], error.norm(dim=-1), torch.nan)
        self.trials.append(ActuatorTrial(actuator, sizes, copy.deepcopy(loss.state_dict())))
        return self.trials[-1]

    def _delays(self) -> ActuatorTrial:
        """Whole steps, until two in a row are no better."""
        best, worse = self._attempt(Actuator(delay_steps=1.0)), 0
        for delay in range(2, BEFORE + 1):
            if worse == 2 or best.error <= _GOOD:
                break
            trial = self._attempt(Actuator(delay_steps=float(delay)))
            best, worse = (trial, 0) if trial.error < best.error else (best, worse + 1)
        return best

    def _lag(self, dead: float) -> ActuatorTrial:
        """The best lag behind a dead time."""

        def at(lag: float) -> ActuatorTrial:
            return self._attempt(Actuator(delay_steps=dead, lag=lag * self.task.time_step))

        coarse = [at(lag) for lag in _LAGS]
        least = coarse.index(_lowest(coarse))
        ends = _LAGS[max(least - 1, 0)], _LAGS[min(least + 1, len(_LAGS) - 1)]
        return _lowest([coarse[least], *self._narrow(at, *ends)])

    def _fraction(self, delay: float) -> ActuatorTrial:
        """The best dead time within a step of a whole one."""

        def at(value: float) -> ActuatorTrial:
            return self._attempt(Actuator(delay_steps=value))

        low, high = max(delay - 1.0, 0.0), delay + 1.0
        return _lowest(self._narrow(at, low, high))

    def _narrow(
        self, at: Callable[[float], ActuatorTrial], low: float, high: float
    ) -> Sequence[ActuatorTrial]:
        """Search the least error between two numbers by golden sections."""
        golden = (5.0**0.5 - 1.0) / 2.0
        points = [high - golden * (high - low), low + golden * (high - low)]
        trials = [at(point) for point in points]
        found = list(trials)
        for _ in range(_NARROW - 2):
            if trials[0].error < trials[1].error:
                high, points[1], trials[1] = points[1], points[0], trials[0]
                points[0] = high - golden * (high - low)
                trials[0] = at(points[0])
                found.append(trials[0])
            else:
                low, points[0], trials[0] = points[0], points[1], trials[1]
                points[1] = low + golden * (high - low)
                trials[1] = at(points[1])
                found.append(trials[1])
        return found


def _lowest(trials: Sequence[ActuatorTrial]) -> ActuatorTrial:
    return min(trials, key=lambda trial: trial.error)


def _delay(trial: ActuatorTrial) -> float:
    delay = trial.actuator.delay_steps
    assert isinstance(delay, float)  # one number for all actions is tried
    return delay


def _after_others(data: TensorDictBase) -> Tensor:
    """Numbers of the transitions that have :data:`BEFORE` others of their stretch before them."""
    rows = [torch.arange(a + BEFORE, b) for a, b in episodes(data) if b > a + BEFORE]
    return torch.cat(rows) if rows else torch.zeros(0, dtype=torch.long)


def _without(columns: Tensor, values: Tensor) -> Tensor:
    """What is left of values ``[N, k]`` when their linear part in columns ``[N, c]`` is gone."""
    return values - columns @ torch.linalg.lstsq(columns, values, driver="gelsd").solution
