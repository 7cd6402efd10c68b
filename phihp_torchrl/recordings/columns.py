"""Which column of a log holds which state, command or input, and how it becomes SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phihp_torchrl.config import ConfigError, from_mapping
from phihp_torchrl.recordings.tables import Table
from phihp_torchrl.recordings.units import factor_of
from phihp_torchrl.systems import System

RESERVED = ("time", "episode")
"""Names besides those of the system: the time stamps and the number of the episode."""

_DEGREES = 100.0  # an angle without a unit that ranges over more within one turn is in degrees


@dataclass(frozen=True)
class Column:
    """A column of a log, and how its numbers become those of the system.

    A value is ``scale`` times the number in the column, converted from ``unit`` to SI units, plus
    ``offset``.

    Args:
        column: name of the column.
        unit: unit of the column, e.g. ``deg``, ``mm``, ``ms`` or ``percent``; ``None`` for the unit
            of the system.
        scale: a factor; a negative one turns the sign.
        offset: what is added last, in the unit of the system.
        per_turn: counts in a turn, for the unit ``counts``.
        cos: name of a column that holds the cosine of an angle, instead of ``column``.
        sin: name of the column that holds its sine.

    Raises:
        ConfigError: for an unknown unit, a factor of zero or numbers that are not finite, and for
            anything but either ``column`` or both ``cos`` and ``sin``.

    Examples:
        >>> Column("joint_deg", unit="deg", scale=-1.0).convert(np.array([90.0, -180.0])).round(3)
        array([-1.571,  3.142])
        >>> Column("encoder", unit="counts", per_turn=2048).convert(np.array([512.0])).round(3)
        array([1.571])
    """

    column: str | None = None
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    per_turn: float | None = None
    cos: str | None = None
    sin: str | None = None

    def __post_init__(self) -> None:
        pair = (self.cos is not None, self.sin is not None)
        if all(pair) == (self.column is not None) or any(pair) != all(pair):
            raise ConfigError("column", "expected the name of a column, or both `cos` and `sin`.")
        if not math.isfinite(self.scale) or self.scale == 0.0:
            raise ConfigError("scale", f"expected a finite number other than 0, got {self.scale}.")
        if not math.isfinite(self.offset):
            raise ConfigError("offset", f"expected a finite number, got {self.offset}.")
        if (self.unit == "counts") != (self.per_turn is not None):
            raise ConfigError("per_turn", "expected the counts in a turn with `unit: counts` only.")
        if self.per_turn is not None and not 0 < self.per_turn < math.inf:
            raise ConfigError("per_turn", f"expected a positive number, got {self.per_turn}.")
        if self.unit is not None:
            factor_of(self.unit, "unit")
        if all(pair) and (self.unit is not None or abs(self.scale) != 1.0):
            raise ConfigError(
                "unit", "expected none, and a scale of 1 or -1, with `cos` and `sin`."
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The columns that are read."""
        return tuple(name for name in (self.column, self.cos, self.sin) if name is not None)

    def convert(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Convert numbers of the column to the unit of the system, any shape."""
        factor = 1.0 if self.unit is None else factor_of(self.unit, "unit")
        return self.scale * (factor / (self.per_turn or 1.0)) * numbers + self.offset

    def read(self, table: Table) -> NDArray[Any]:
        """Read the values from a table, float64 ``[rows]``; NaN where there is none."""
        if self.column is not None:
            return self.convert(table.numbers(self.column))
        cos, sin = (table.numbers(name) for name in self.names)
        return self.scale * np.arctan2(sin, cos) + self.offset


def read_columns(system: System, columns: Mapping[str, Any]) -> dict[str, Column]:
    """Read the setting ``columns``: a name or the fields of a :class:`Column`, for each name.

    Names that are not in the setting have the column of their own name.

    Args:
        system: the system, whose states, actions and inputs may be named, beside ``time`` and
            ``episode``.
        columns: the setting.

    Returns:
        The columns that were given, by name.

    Raises:
        ConfigError: for a name that the system does not have, and a wrong field of a column; the
            message names it.
    """
    names = (*RESERVED, *system.state_names, *system.action_names, *system.input_names)
    found: dict[str, Column] = {}
    for name, given in columns.items():
        key = f"columns.{name}"
        if name not in names:
            close = get_close_matches(str(name), names, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else "."
            raise ConfigError(key, f"expected one of {list(names)}, got {name!r}{hint}")
        if isinstance(given, Column):
            found[name] = given
        elif isinstance(given, str):
            found[name] = Column(given)
        elif isinstance(given, Mapping):
            found[name] = from_mapping(Column, given, key)
        else:
            raise ConfigError(key, f"expected the name of a column or its fields, got {given!r}.")
        _check_kind(system, name, found[name], key)
    return found


def _check_kind(system: System, name: str, column: Column, key: str) -> None:
    kind = "time" if name == "time" else "angle" if name in system.angles else None
    if kind is not None and column.unit is not None:
        factor_of(column.unit, f"{key}.unit", kind=kind)
    if column.cos is not None and kind != "angle":
        raise ConfigError(f"{key}.cos", f"expected an angle, {name!r} is none of {system.angles}.")


def choose_columns(
    system: System, given: Mapping[str, Column], table: Table, *, clock: bool
) -> dict[str, Column]:
    """Return the column of each name in ``table``; a velocity that it does not have is left out.

    Args:
        system: the system.
        given: the columns that were named.
        table: the table.
        clock: whether time stamps are needed, because no fixed time step was given.

    Raises:
        ConfigError: for a column that the table does not have; the message lists those it has.
    """
    known = {**_of_observations(system, table), **given}
    chosen: dict[str, Column] = {}
    for name in (*RESERVED, *system.state_names, *system.action_names, *system.input_names):
        column = known.get(name, Column(name))
        missing = [each for each in column.names if each not in table.columns]
        if not missing:
            if name != "time" or clock:
                chosen[name] = column
            continue
        optional = name == "episode" or name in system.velocity_of.values()
        if name in given or not (optional or (name == "time" and not clock)):
            extra = " Without time stamps, set time_step." if name == "time" else ""
            raise ConfigError(
                f"columns.{name}",
                f"{table.source} has no column {missing[0]!r}{_hint(missing[0], table)} "
                f"Its columns are {sorted(table.columns)}.{extra}",
            )
    return chosen


def looks_like_degrees(column: Column, values: NDArray[Any]) -> bool:
    """Whether the values of an angle that has no unit are probably in degrees."""
    if column.unit is not None or column.cos is not None or column.scale not in (1.0, -1.0):
        return False
    finite = values[np.isfinite(values)]
    if not len(finite):
        return False
    low, high = finite.min(), finite.max()
    within = (low >= -181.0 and high <= 181.0) or (low >= -1.0 and high <= 361.0)
    return bool(within and high - low > _DEGREES)


def _of_observations(system: System, table: Table) -> dict[str, Column]:
    """The columns of a data set whose observations are those of the task, in its order."""
    size = sum(name.startswith("observations[") for name in table.columns)
    if size != system.observation_dim:
        return {}
    found: dict[str, Column] = {}
    place = 0
    for name in system.state_names:
        if name in system.angles:
            pair = (f"observations[{place}]", f"observations[{place + 1}]")
            found[name] = Column(cos=pair[0], sin=pair[1])
            place += 2
        else:
            found[name] = Column(f"observations[{place}]")
            place += 1
    for i, name in enumerate(system.action_names):
        found[name] = Column(f"actions[{i}]")
    return {n: column for n, column in found.items() if n not in table.columns}


def _hint(name: str, table: Table) -> str:
    close = get_close_matches(name, table.columns, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else "."
