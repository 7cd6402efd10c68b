"""A check of the names by which a system declares its state, its actions and its inputs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from phihp_torchrl.config import ConfigError, meant

if TYPE_CHECKING:
    from phihp_torchrl.systems.base import System


def check_names(system: System) -> None:
    """Check that each name is there once, and that angles, positions and velocities are states.

    Raises:
        ConfigError: naming the system's class, the attribute, and the name that does not fit.
    """
    taken: dict[str, str] = {}
    for attribute in ("state_names", "action_names", "input_names"):
        for name in _names(system, attribute):
            if name in taken:
                whose = f"in {taken[name]} too" if taken[name] != attribute else "twice"
                raise _error(
                    system, attribute, f"expected names of their own, got {name!r} {whose}."
                )
            taken[name] = attribute
    pairs = system.velocity_of
    if not isinstance(pairs, Mapping):
        raise _error(system, "velocity_of", f"expected velocities by position, got {pairs!r}.")
    angles = _names(system, "angles")
    _check_states(system, "angles", angles)
    _check_states(system, "velocity_of", [*pairs, *pairs.values()])
    if twice := [name for i, name in enumerate(angles) if name in angles[:i]]:
        raise _error(system, "angles", f"expected names of their own, got {twice[0]!r} twice.")


def _names(system: System, attribute: str) -> tuple[str, ...]:
    names = getattr(system, attribute, None)
    if not isinstance(names, (tuple, list)) or not all(isinstance(name, str) for name in names):
        hint = f"; a tuple of one is ({names!r},)." if isinstance(names, str) else "."
        raise _error(system, attribute, f"expected a tuple of names, got {names!r}{hint}")
    return tuple(names)


def _check_states(system: System, attribute: str, names: Collection[str]) -> None:
    states = system.state_names
    for name in names:
        if name not in states:
            hint = meant(name, states)
            raise _error(
                system, attribute, f"expected some of the states {list(states)}, got {name!r}{hint}"
            )


def _error(system: System, attribute: str, reason: str) -> ConfigError:
    return ConfigError(f"{type(system).__name__}.{attribute}", reason)
