"""The parts of an identification: estimates, the path of a command, errors, pictures, warnings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from phihp_torchrl.systems import Constant
from phihp_torchrl.tasks import Actuator, Numbers

IDENTIFIED = "identified"
IF_COMPLETE = "identified only if the equations are complete"
COMBINED = "only in combination with "
NOT_IDENTIFIED = "not identified by these data"
FIXED = "fixed"
AT_LIMIT = "at its limit"


@dataclass(frozen=True)
class Estimate:
    """What the data say of one number.

    Args:
        guess: the first guess.
        estimate: the estimate; the guess where nothing was fitted.
        low: lower end of the 95 % interval; ``None`` where the data give none.
        high: its upper end.
        verdict: ``"identified"``, ``"identified only if the equations are complete"``,
            ``"only in combination with ..."``, ``"not identified by these data"``, ``"fixed"`` or
            ``"at its limit"``.
        advice: what would identify it, or what to do; empty where nothing is needed.
    """

    guess: float
    estimate: float
    low: float | None = None
    high: float | None = None
    verdict: str = IDENTIFIED
    advice: str = ""


@dataclass(frozen=True)
class ActuatorTrial:
    """One path of the command that was tried.

    Args:
        part: what was tried, in words, such as ``"delay 2"`` or ``"delay 2, lag"``.
        values: numbers of the parts, by name.
        cost: robust mean square residual of the trial's windows, in units of the noise.
        kept: whether it became the answer.
        rival: whether it acts earlier or later than the answer, and is not clearly worse.
    """

    part: str
    values: Mapping[str, Numbers]
    cost: float
    kept: bool = False
    rival: bool = False


@dataclass(frozen=True)
class ActuatorEstimate:
    """What happens to a command before it acts.

    A part that the data did not ask for has its neutral number: no delay, no lag, no limit of the
    rate, no dead zone, a gain of one.

    Args:
        delay_steps: dead time in steps of the data (their median), for all actions or for each.
        lag_s: time constant in seconds, for all actions or for each.
        slew: largest rate in units of the action per second; ``None`` for no limit.
        dead_zone: size of commands that have no effect, for all actions or for each.
        gain_low: gain of negative commands, likewise.
        intervals: 95 % intervals of the fitted parts, by name, such as ``"lag_s"``, or
            ``"lag_s of volts"`` for one action.
        tried: every path that was tried, in order.
        actions: names of the actions.
    """

    delay_steps: Numbers = 0.0
    lag_s: Numbers = 0.0
    slew: float | None = None
    dead_zone: Numbers = 0.0
    gain_low: Numbers = 1.0
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    tried: tuple[ActuatorTrial, ...] = ()
    actions: tuple[str, ...] = ()

    def rows(self, part: str) -> dict[str, float | None]:
        """The numbers of a part by their names in :attr:`intervals`."""
        value = getattr(self, part)
        if not isinstance(value, (tuple, list)):
            return {part: value}
        return {f"{part} of {n}": v for n, v in zip(self.actions, value, strict=True)}

    @property
    def actuator(self) -> Actuator | None:
        """The fitted actuator, or ``None`` where a command acts as it is and at once."""
        found = Actuator(self.delay_steps, self.lag_s, self.slew, self.dead_zone, self.gain_low)
        return found if found.config else None


@dataclass(frozen=True)
class StateError:
    """Error of predictions of one measured state.

    Args:
        rmse: root mean square error in the unit of the state.
        share: that, as a share of the root mean square change over the same time.
        floor_ratio: that, as a multiple of the noise of the measurement.
        count: predictions that were compared.
    """

    rmse: float
    share: float
    floor_ratio: float
    count: int


@dataclass(frozen=True)
class HorizonError:
    """Errors of predictions over one number of steps, on stretches that took no part in the fit.

    Args:
        states: by the name of a measured state.
        share: root mean square of the shares of the states.
        floor_ratio: root mean square of the multiples of the noise.
    """

    states: Mapping[str, StateError]
    share: float
    floor_ratio: float


@dataclass(frozen=True)
class Region:
    """Errors in a part of the state space.

    Args:
        state: the state that is divided, or ``"stop"`` for stretches that meet a stop.
        low: where the part begins, in the unit of the state.
        high: where it ends.
        windows: held-out stretches in it.
        errors: by the name of a measured state, at the longest horizon.
    """

    state: str
    low: float | None
    high: float | None
    windows: int
    errors: Mapping[str, StateError]


@dataclass(frozen=True)
class Rollout:
    """A prediction beside what was measured. Lists have one entry a sample; ``None`` is missing.

    Args:
        source: where the samples are from.
        episode: number of the episode.
        begin: samples before the prediction, from which its start was estimated.
        time: seconds.
        measured: by state.
        predicted: by state: the fit to the samples before ``begin``, and then the prediction.
        action: commands by action.
        at_stop: whether the stretch meets a stop.
    """

    source: str
    episode: int
    begin: int
    time: list[float]
    measured: Mapping[str, list[float | None]]
    predicted: Mapping[str, list[float]]
    action: Mapping[str, list[float]]
    at_stop: bool = False


@dataclass(frozen=True)
class Residuals:
    """What the fitted stretches leave over, one entry a sample, for pictures.

    Args:
        time: seconds.
        residual: by measured state, in its unit; ``None`` where it was not measured.
        state: fitted states by name.
        action: commands by action.
        previous: commands of one, two, ... samples before, by ``"<action> 1 before"`` and so on.
        autocorrelation: of each measured state's residuals, one, two, ... samples apart.
    """

    time: list[float]
    residual: Mapping[str, list[float | None]]
    state: Mapping[str, list[float]]
    action: Mapping[str, list[float]]
    previous: Mapping[str, list[float]]
    autocorrelation: Mapping[str, list[float]]


@dataclass(frozen=True)
class Finding:
    """Something that a reader must know before trusting the numbers.

    Args:
        code: a word for programs, such as ``"delay"`` or ``"stops"``.
        text: what was found.
        advice: what to do about it.
    """

    code: str
    text: str
    advice: str

    def __str__(self) -> str:
        return f"{self.text} {self.advice}"


_INSIDE = 1e-3
"""How far inside its range a first guess stays, as a share of it: its limits are not allowed."""


def inside(declared: Constant, value: float) -> float:
    """An estimate of a constant as a first guess, inside the range of a bounded one."""
    if not declared.bounded:
        return value
    room = _INSIDE * (declared.high - declared.low)
    return min(max(value, declared.low + room), declared.high - room)
