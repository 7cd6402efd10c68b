"""The units of columns, as factors to the SI units in which a system's equations are written."""

from __future__ import annotations

import math
from difflib import get_close_matches

from phihp_torchrl.config import ConfigError

_TURN = 2.0 * math.pi

UNITS: dict[str, tuple[float, str]] = {
    # time
    "s": (1.0, "time"),
    "ms": (1e-3, "time"),
    "us": (1e-6, "time"),
    "ns": (1e-9, "time"),
    "min": (60.0, "time"),
    "h": (3600.0, "time"),
    # angles and their rates
    "rad": (1.0, "angle"),
    "mrad": (1e-3, "angle"),
    "deg": (math.pi / 180.0, "angle"),
    "turn": (_TURN, "angle"),
    "counts": (_TURN, "angle"),  # divided by the counts in a turn
    "rad/s": (1.0, "rate"),
    "deg/s": (math.pi / 180.0, "rate"),
    "rpm": (_TURN / 60.0, "rate"),
    # lengths and their rates
    "m": (1.0, "length"),
    "cm": (1e-2, "length"),
    "mm": (1e-3, "length"),
    "um": (1e-6, "length"),
    "km": (1e3, "length"),
    "in": (0.0254, "length"),
    "m/s": (1.0, "speed"),
    "cm/s": (1e-2, "speed"),
    "mm/s": (1e-3, "speed"),
    "km/h": (1.0 / 3.6, "speed"),
    # what commands are in
    "N": (1.0, "force"),
    "mN": (1e-3, "force"),
    "kN": (1e3, "force"),
    "Nm": (1.0, "torque"),
    "mNm": (1e-3, "torque"),
    "V": (1.0, "voltage"),
    "mV": (1e-3, "voltage"),
    "A": (1.0, "current"),
    "mA": (1e-3, "current"),
    "1": (1.0, "share"),
    "percent": (1e-2, "share"),
    "%": (1e-2, "share"),
    # process quantities
    "Pa": (1.0, "pressure"),
    "kPa": (1e3, "pressure"),
    "bar": (1e5, "pressure"),
    "l": (1e-3, "volume"),
    "m3": (1.0, "volume"),
    "l/s": (1e-3, "flow"),
    "l/min": (1e-3 / 60.0, "flow"),
    "m3/s": (1.0, "flow"),
    "m3/h": (1.0 / 3600.0, "flow"),
    "kg": (1.0, "mass"),
    "g": (1e-3, "mass"),
}
"""Factor to the SI unit, and kind of quantity, by the name of the unit."""


def factor_of(unit: str, key: str, *, kind: str | None = None) -> float:
    """Return the factor from ``unit`` to SI units.

    Args:
        unit: the name of the unit.
        key: the setting, for messages.
        kind: the kind of quantity that it must be a unit of.

    Raises:
        ConfigError: for an unknown unit, or one of another kind.
    """
    if unit not in UNITS:
        close = get_close_matches(unit, UNITS, n=1, cutoff=0.5)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        raise ConfigError(
            key,
            f"unknown unit {unit!r}{hint} Expected one of {sorted(UNITS)}, or a `scale` instead.",
        )
    factor, found = UNITS[unit]
    if kind is not None and found != kind:
        names = sorted(name for name, (_, of) in UNITS.items() if of == kind)
        raise ConfigError(key, f"expected a unit of {kind}, one of {names}, got {unit!r}.")
    return factor
