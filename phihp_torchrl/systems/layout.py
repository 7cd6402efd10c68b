"""From names of a system's components to the layout that integrators use, with limits and stops."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import StateLayout
from phihp_torchrl.systems.names import check_names

if TYPE_CHECKING:
    from phihp_torchrl.systems.base import System


def make_layout(
    system: System,
    velocity_limits: Mapping[str, float | tuple[float, float]],
    position_limits: Mapping[str, tuple[float, float]],
    restitution: float | Mapping[str, float],
) -> StateLayout:
    """Return the layout of a system's state; :meth:`System.layout` says what the limits are."""
    check_names(system)
    positions, velocities = list(system.velocity_of), list(system.velocity_of.values())
    _check_names("velocity_limits", velocity_limits, velocities)
    _check_names("position_limits", position_limits, positions)
    for name, pair in position_limits.items():
        _check_stop(name, pair, name in system.angles)
    if not isinstance(restitution, Mapping):
        _check_share("restitution", restitution)
        restitution = dict.fromkeys(position_limits, restitution)
    _check_names("restitution", restitution, list(position_limits))
    for name, value in restitution.items():
        _check_share(f"restitution.{name}", value)
    index = system.state_names.index
    return StateLayout(
        size=system.state_dim,
        pairs=tuple((index(q), index(v)) for q, v in system.velocity_of.items()),
        limits=tuple(velocity_limits.get(name, math.inf) for name in velocities),
        stops=tuple(position_limits.get(name, (-math.inf, math.inf)) for name in positions),
        restitution=tuple(restitution.get(name, 0.0) for name in positions),
    )


def _check_names(what: str, given: Mapping[str, Any], names: list[str]) -> None:
    if unknown := sorted(set(given) - set(names)):
        raise ConfigError(what, f"unknown {unknown}, expected some of {names}.")


def _check_stop(name: str, pair: Any, angle: bool) -> None:
    key = f"position_limits.{name}"
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and pair[0] < pair[1]):
        raise ConfigError(key, f"expected (low, high) with low < high, got {pair}.")
    if angle and not (-math.pi <= pair[0] and pair[1] <= math.pi):
        raise ConfigError(
            key,
            f"expected both within [-pi, pi], got {pair}: beyond half a turn an observation of the "
            "angle does not tell at which stop it is.",
        )


def _check_share(key: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
        raise ConfigError(key, f"expected a number in [0, 1], got {value!r}.")
