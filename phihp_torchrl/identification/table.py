"""An identification on a console."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def lay_out(found: Mapping[str, Any]) -> str:
    """Lines of text for the plain values of an identification."""
    parts = [_constants(found), _actuator(found["actuator"]), _bounces(found), _errors(found)]
    parts.append("\n".join(f"! {warning}" for warning in found["warnings"]))
    return "\n\n".join(part for part in parts if part)


def _constants(found: Mapping[str, Any]) -> str:
    rows = [("constant", "guess", "estimate", "95 % interval", "verdict")]
    for group in ("constants", "combinations"):
        for name, c in found[group].items():
            interval = "–" if c["low"] is None else f"{_n(c['low'])} to {_n(c['high'])}"
            rows.append((name, _n(c["guess"]), _n(c["estimate"]), interval, c["verdict"]))
    return _columns(rows)


def _actuator(actuator: Mapping[str, Any]) -> str:
    neutral = {"delay_steps": 0.0, "lag_s": 0.0, "slew": None, "dead_zone": 0.0, "gain_low": 1.0}
    rows = [("actuator", "estimate", "95 % interval")]
    for name, value in neutral.items():
        if actuator[name] != value:
            ends = actuator["intervals"].get(name)
            interval = f"{_n(ends[0])} to {_n(ends[1])}" if ends else "–"
            rows.append((name, _n(actuator[name]), interval))
    if len(rows) == 1:
        return "actuator: commands act as they are, and at once"
    return _columns(rows)


def _bounces(found: Mapping[str, Any]) -> str:
    rows = [("stops of", "share of the speed that is left", "95 % interval", "verdict")]
    for name, e in found["restitution"].items():
        interval = "–" if e["low"] is None else f"{_n(e['low'])} to {_n(e['high'])}"
        rows.append((name, _n(e["estimate"]), interval, e["verdict"]))
    return _columns(rows) if len(rows) > 1 else ""


def _errors(found: Mapping[str, Any]) -> str:
    rows = [("state", "noise", "steps", "error", "share of change", "times noise")]
    for name, noise in found["noise"].items():
        for steps, by_state in found["errors"].items():
            error = by_state.get(name)
            if error:
                numbers = (_n(error["rmse"]), _n(error["share"]), _n(error["floor_ratio"]))
                rows.append((name, _n(noise), steps, *numbers))
    return _columns(rows)


def _n(value: float | None) -> str:
    return "–" if value is None else f"{value:.5g}"


def _columns(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    padded = ("  ".join(t.ljust(w) for t, w in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in padded)
