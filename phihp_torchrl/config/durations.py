"""Settings in steps that may be given in seconds, and a discount by its time constant.

A number counts steps of the task. A text such as ``"1.5 s"`` is a duration, which keeps its meaning
when the time step changes. Settings hold what the user wrote; :func:`resolve_seconds` replaces
texts by numbers once the time step is known, which is when a run starts.
"""

from __future__ import annotations

import math
import re
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from phihp_torchrl.config.checks import is_whole
from phihp_torchrl.config.errors import ConfigError

T = TypeVar("T")

_STEPS, _DISCOUNT = "steps", "discount"

# To a type checker settings are the numbers that they are once resolved; the reader and the
# resolver, which look at a running program, find that they may be texts.
if TYPE_CHECKING:
    Steps = int
    Discount = float
else:
    Steps = Annotated[int | str, _STEPS]
    """A number of steps, or a duration such as ``"1.5 s"``."""
    Discount = Annotated[float | str, _DISCOUNT]
    """A discount per step, or its time constant τ such as ``"5 s"``: exp(-time_step / τ)."""

_TEXT = re.compile(r"\s*(\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+)\s*(ms|s)\s*")
_UNITS = {"s": 1.0, "ms": 1e-3}


def parse_seconds(text: str) -> float:
    """Read a duration such as ``"1.5 s"`` or ``"40 ms"``, in seconds.

    Raises:
        ConfigError: for a text that is none, or a duration that is not positive and finite.

    Examples:
        >>> parse_seconds("1.5 s"), parse_seconds("40ms")
        (1.5, 0.04)
    """
    match = _TEXT.fullmatch(text)
    seconds = float(match[1]) * _UNITS[match[2]] if match else 0.0
    if not 0 < seconds < math.inf:
        raise ConfigError("seconds", f"expected a duration such as '1.5 s', got {text!r}.")
    return seconds


def steps_in(text: str, time_step: float) -> int:
    """The number of steps in a duration, to the nearest one.

    Args:
        text: the duration, such as ``"1.5 s"``.
        time_step: seconds in a step.

    Raises:
        ConfigError: for a text that is no duration, and for less than half a step.

    Examples:
        >>> steps_in("1.5 s", time_step=0.04), steps_in("0.06 s", time_step=0.04)
        (38, 2)
    """
    # A quotient of decimal numbers lies a rounding error beside the half that it stands for.
    steps = math.floor(round(parse_seconds(text) / time_step, 9) + 0.5)
    if steps < 1:
        raise ConfigError("seconds", f"expected at least a step of {time_step:g} s, got {text!r}.")
    return steps


def discount_of(text: str, time_step: float) -> float:
    """The discount per step, γ = exp(-time_step / τ), of the time constant τ that a text names.

    Raises:
        ConfigError: for a text that is no duration, and for less than a step.

    Examples:
        >>> round(discount_of("8 s", time_step=0.04), 4)
        0.995
    """
    seconds = parse_seconds(text)
    if seconds < time_step:
        raise ConfigError(
            "seconds",
            f"expected a time constant of at least a step of {time_step:g} s, got {text!r}.",
        )
    return math.exp(-time_step / seconds)


def check_steps(config: object, *names: str) -> None:
    """Refuse a field that is neither a whole number of at least 1 nor a duration in seconds.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_steps(SimpleNamespace(horizon="2 s", max_age=0), "horizon", "max_age")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: max_age: expected a whole number >= 1 of steps, or \
seconds such as '1.5 s', got 0.
    """
    for name in names:
        value = getattr(config, name)
        if not (_is_duration(value) or is_whole(value, 1)):
            raise ConfigError(
                name,
                f"expected a whole number >= 1 of steps, or seconds such as '1.5 s', "
                f"got {value!r}.",
            )


def check_discount(config: object, *names: str, least_open: bool = True) -> None:
    """Refuse a field that is neither a discount in (0, 1] nor a time constant in seconds.

    Args:
        config: the settings.
        names: names of the fields to check.
        least_open: whether 0 is refused.

    Raises:
        ConfigError: for the first such field.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_discount(SimpleNamespace(gamma="5 s"), "gamma")
        >>> check_discount(SimpleNamespace(gamma="5"), "gamma")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: gamma: expected a number in (0, 1], or a time constant \
such as '5 s', got '5'.
    """
    for name in names:
        value = getattr(config, name)
        if _is_duration(value):
            continue
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not 0 <= value <= 1 or (least_open and value == 0):
            interval = "(0, 1]" if least_open else "[0, 1]"
            raise ConfigError(
                name,
                f"expected a number in {interval}, or a time constant such as '5 s', "
                f"got {value!r}.",
            )


def in_seconds(value: object) -> bool:
    """Whether a setting is still a text of seconds, which cannot be compared with steps yet.

    Examples:
        >>> in_seconds("0.2 s"), in_seconds(5)
        (True, False)
    """
    return isinstance(value, str)


def resolve_seconds(config: T, time_step: float) -> T:
    """Return settings in which every text of seconds is a number for this time step.

    Args:
        config: a dataclass of settings; those inside it are resolved too.
        time_step: seconds in a step of the task.

    Raises:
        ConfigError: for a duration of less than half a step, a time constant of less than a step,
            and numbers that do not fit each other once they are known; the message has the dotted
            name.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> settings = CEMConfig(planning_horizon="0.2 s", gamma="8 s")
        >>> settings.planning_horizon
        '0.2 s'
        >>> settings = resolve_seconds(settings, time_step=0.04)
        >>> settings.planning_horizon, round(settings.gamma, 4)
        (5, 0.995)
    """
    changes: dict[str, Any] = {}
    for name, kind, value in _durations(config):
        try:
            if kind is None:
                changes[name] = resolve_seconds(value, time_step)
            else:
                read = discount_of if kind == _DISCOUNT else steps_in
                changes[name] = read(value, time_step)
        except ConfigError as error:
            raise (
                error.inside(name) if kind is None else ConfigError(name, error.reason)
            ) from error
    if all(value is getattr(config, name) for name, value in changes.items()):
        return config
    return replace(config, **changes)  # type: ignore[type-var]


def refuse_seconds(config: object) -> None:
    """Refuse texts of seconds where no time step is known that could resolve them.

    Raises:
        ConfigError: for the first such text.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> refuse_seconds(CEMConfig(planning_horizon="0.2 s"))
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: planning_horizon: expected a number, for no time step \
is known here, got '0.2 s'; resolve_seconds(config, time_step) makes it one.
    """
    for name, kind, value in _durations(config):
        if kind is None:
            refuse_seconds(value)
        else:
            raise ConfigError(
                name,
                f"expected a number, for no time step is known here, got {value!r}; "
                "resolve_seconds(config, time_step) makes it one.",
            )


def _durations(config: Any) -> list[tuple[str, str | None, Any]]:
    """Name, kind and value of each text of seconds in a dataclass, and of each dataclass in it."""
    found: list[tuple[str, str | None, Any]] = []
    hints = get_type_hints(type(config), include_extras=True)
    for f in fields(config):
        value = getattr(config, f.name)
        if not f.init:
            continue
        if is_dataclass(value):
            found.append((f.name, None, value))
        elif isinstance(value, str) and (kind := _kind(hints[f.name])):
            found.append((f.name, kind, value))
    return found


def _kind(hint: Any) -> str | None:
    """Whether a hint is that of steps or of a discount, optional ones included."""
    if get_origin(hint) is Annotated:
        return next((kind for kind in hint.__metadata__ if kind in (_STEPS, _DISCOUNT)), None)
    return next((kind for kind in map(_kind, get_args(hint)) if kind), None)


def _is_duration(value: Any) -> bool:
    if not isinstance(value, str):
        return False
    try:
        parse_seconds(value)
    except ConfigError:
        return False
    return True
