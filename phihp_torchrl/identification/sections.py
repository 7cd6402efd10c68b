"""Tables of the page of an identification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

from phihp_torchrl.display import Cell, interval_bar, number, table
from phihp_torchrl.identification.charts import with_unit
from phihp_torchrl.identification.parts import (
    AT_LIMIT,
    COMBINED,
    FIXED,
    IDENTIFIED,
    IF_COMPLETE,
    NOT_IDENTIFIED,
    Estimate,
    StateError,
)
from phihp_torchrl.identification.result import Identification
from phihp_torchrl.tasks import Numbers

_LARGE = 2.0
"""Multiple of the noise from which on an error is marked."""

PARTS = {
    "delay_steps": ("dead time", "steps", 0.0),
    "lag_s": ("lag (time constant)", "s", 0.0),
    "slew": ("largest rate", "units of the action per s", None),
    "dead_zone": ("dead zone", "units of the action", 0.0),
    "gain_low": ("gain of negative commands", "", 1.0),
}
"""Parts of an actuator: what each is, its unit, and its number where there is none."""


def estimates(found: Identification, of: Mapping[str, Estimate], caption: str) -> str:
    """Guess, estimate, interval and verdict of each number, the interval drawn too."""
    head = ["name", "first guess", "estimate", "95 % interval", "drawn", "verdict", "what to do"]
    if not any(e.advice for e in of.values()):
        head.pop()
    rows = [_estimate(with_unit(found, name), e)[: len(head)] for name, e in of.items()]
    return table(head, rows, caption, "stack")


def _estimate(name: str, e: Estimate) -> list[Cell]:
    known = e.verdict != FIXED
    interval = _interval(e.low, e.high) if known else ""
    bar = interval_bar(e.guess, e.estimate, e.low, e.high) if known else ""
    return [
        Cell(escape(name), head=True),
        Cell(number(e.guess), "number"),
        Cell(number(e.estimate, 5), "number"),
        Cell(interval),
        Cell(bar),
        Cell(*verdict(e)),
        Cell(escape(e.advice), "small"),
    ]


def verdict(e: Estimate) -> tuple[str, str]:
    """A verdict in words as HTML, with a sign before it, and its class."""
    text = escape(e.verdict)
    if e.verdict == IDENTIFIED:
        return f"✓ {text}{_precision(e)}", "good"
    if e.verdict == FIXED:
        return f"■ {text}: it was not fitted", "soft"
    if e.verdict == IF_COMPLETE:
        return f"◐ {text}{_precision(e)}", "part"
    if e.verdict == AT_LIMIT:
        return f"▲ {text}", "part"
    if e.verdict.startswith(COMBINED):
        return f"◐ {text}", "part"
    assert e.verdict == NOT_IDENTIFIED, e.verdict
    return f"✗ {text}", "bad"


def _interval(low: float | None, high: float | None) -> str:
    """Both ends, with as many digits as tell them apart."""
    if low is None or high is None:
        return ""
    size, width = max(abs(low), abs(high)), high - low
    digits = 4 if width <= 0 else max(4, 2 + math.ceil(math.log10(size / width)))
    return f"{number(low, digits)} to {number(high, digits)}"


def _precision(e: Estimate) -> str:
    if e.low is None or e.high is None or not e.estimate:
        return ""
    return f", ±\N{NO-BREAK SPACE}{50 * abs((e.high - e.low) / e.estimate):.2g}\N{NO-BREAK SPACE}%"


def actuator_parts(found: Identification) -> str:
    """The parts of the actuator."""
    a, step = found.actuator, found.data.get("step_s")
    rows = []
    for key, (label, unit, neutral) in PARTS.items():
        for name, value in a.rows(key).items():
            ends = a.intervals.get(name)
            words = "none" if value == neutral else f"{number(value)} {unit}"
            if key == "delay_steps" and value and step:
                words += f" ({number(value * step)} s)"
            if key == "gain_low" and value == neutral:
                words = "1, as of positive ones"
            interval = _interval(*ends) if ends else ""
            head = escape(label + name.removeprefix(key))
            rows.append([Cell(head, head=True), Cell(words), Cell(interval)])
    return table(("part", "estimate", "95 % interval"), rows, "Parts of the actuator")


def _numbers(value: Numbers) -> str:
    return " and ".join(number(v) for v in (value if isinstance(value, tuple) else (value,)))


def tried_paths(found: Identification) -> str:
    """Every path of the command that was tried."""
    rows = [
        [
            Cell(escape(trial.part), head=True),
            Cell(escape(", ".join(f"{k} {_numbers(v)}" for k, v in trial.values.items()))),
            Cell(number(trial.cost), "number"),
            Cell("kept", "kept") if trial.kept else Cell("as good" if trial.rival else ""),
        ]
        for trial in found.actuator.tried
    ]
    head = ("tried", "numbers", "cost", "")
    return table(head, rows, "Paths of the command that were tried") if rows else ""


def horizons(found: Identification) -> str:
    """Errors of each measured state, by steps ahead."""
    rows = []
    for steps, error in found.errors.items():
        for name, e in error.states.items():
            rows.append(
                [
                    Cell(f"{escape(with_unit(found, name))}, {_steps(steps)}", head=True),
                    Cell(number(e.rmse, 3), "number"),
                    Cell(_share(e), "number"),
                    Cell(_times(e), "number"),
                    Cell(str(e.count), "number"),
                ]
            )
        if len(error.states) > 1:
            rows.append(
                [
                    Cell(f"all, {_steps(steps)}", head=True),
                    Cell(""),
                    Cell(f"{100 * error.share:.3g} %", "number"),
                    Cell(f"{number(error.floor_ratio, 3)} ×", "number"),
                    Cell(""),
                ]
            )
    head = ("state, steps ahead", "error", "of the change", "of the noise", "count")
    return table(head, rows, "Errors of predictions by state and steps ahead")


def regions(found: Identification) -> str:
    """Errors at the longest horizon, by parts of the state space."""
    names = list(dict.fromkeys(name for region in found.regions for name in region.errors))
    rows = []
    for region in found.regions:
        if region.state == "stop":
            where = "stretches that meet a stop"
        else:
            ends = f"{number(region.low, 3)} to {number(region.high, 3)}"
            where = f"{escape(with_unit(found, region.state))} from {ends}"
        cells = [Cell(where, head=True), Cell(str(region.windows), "number")]
        for name in names:
            e = region.errors.get(name)
            cells.append(Cell(f"{number(e.rmse, 3)}, {_times(e)}" if e else "none", "number"))
        rows.append(cells)
    head = ("begun at", "stretches", *(with_unit(found, name) for name in names))
    return table(head, rows, "Errors by regions of the states") if rows else ""


def noise(found: Identification) -> str:
    """The noise of each measured state."""
    without: Mapping[str, Any] = found.data.get("noise_without_model") or {}
    rows = [
        [
            Cell(escape(with_unit(found, name)), head=True),
            Cell(number(value, 3), "number"),
            Cell(number(without.get(name), 3), "number"),
        ]
        for name, value in found.noise.items()
    ]
    head = ("state", "of the fit's residuals", "without the equations")
    return table(head, rows, "Noise of each measured state, standard deviation")


def _steps(steps: str) -> str:
    return f"{steps} step{'' if steps == '1' else 's'}"


def _share(e: StateError) -> str:
    return "–" if e.share != e.share else f"{100 * e.share:.3g} %"


def _times(e: StateError) -> str:
    """A multiple of the noise, marked where it is large."""
    text = f"{number(e.floor_ratio, 3)} ×"
    return f'<strong class="bad">▲ {text}</strong>' if e.floor_ratio > _LARGE else text
