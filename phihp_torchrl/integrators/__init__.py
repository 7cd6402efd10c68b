"""Integrators from ds/dt to the next state, the same for simulated worlds and for models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from phihp_torchrl.config import ConfigError, Registry, check_choice, check_count
from phihp_torchrl.integrators.base import Derivative, FixedStepIntegrator, Integrator, StateLayout
from phihp_torchrl.integrators.dopri5 import Dopri5
from phihp_torchrl.integrators.rk4 import RK4
from phihp_torchrl.integrators.semi_implicit_euler import SemiImplicitEuler

__all__ = ["RK4", "Dopri5", "Integrator", "SemiImplicitEuler", "StateLayout", "make_integrator"]

INTEGRATORS: Registry[type[Integrator]] = Registry("integrator")
"""Integrators by the name that settings use."""

_MOST_SUBSTEPS = 1000
"""A plan takes thousands of control steps, so that more would seem to hang."""

for _integrator in (SemiImplicitEuler, RK4, Dopri5):
    INTEGRATORS.register(_integrator.name, _integrator)


def make_integrator(integrator: str | Integrator, **settings: Any) -> Integrator:
    """Return the integrator of that name; an instance passes through.

    Args:
        integrator: ``"semi_implicit_euler"``, ``"rk4"``, ``"dopri5"`` or an :class:`Integrator`.
        settings: arguments of the named integrator: ``substeps`` of the first two, the tolerances
            ``rtol`` and ``atol`` of the last.

    Raises:
        ConfigError: for an unknown name, or an argument that the integrator does not have.

    Examples:
        >>> make_integrator("rk4", substeps=4).settings
        {'substeps': 4}
    """
    if isinstance(integrator, Integrator):
        return integrator
    try:
        return INTEGRATORS.find(integrator)(**settings)
    except TypeError as error:
        raise ConfigError("integrator", f"{integrator!r} has no such settings: {error}") from error


def check_integrator(config: Any) -> None:
    """Refuse settings whose fields ``integrator`` and ``substeps`` name no integrator.

    Raises:
        ConfigError: for an unknown integrator, a number of substeps that is not positive, and
            several substeps of an integrator that chooses its steps.

    Examples:
        >>> from types import SimpleNamespace
        >>> check_integrator(SimpleNamespace(integrator="dopri5", substeps=2))
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: substeps: expected 1 for dopri5, got 2.
    """
    check_choice(config, "integrator", INTEGRATORS)
    check_count(config, "substeps")
    if config.substeps > _MOST_SUBSTEPS:
        raise ConfigError("substeps", f"expected at most {_MOST_SUBSTEPS}, got {config.substeps}.")
    if config.substeps > 1 and not has_substeps(config.integrator):
        raise ConfigError("substeps", f"expected 1 for {config.integrator}, got {config.substeps}.")


def integrator_of(config: Any) -> Integrator:
    """Return the integrator that the fields ``integrator`` and ``substeps`` of settings name.

    Examples:
        >>> from types import SimpleNamespace
        >>> integrator_of(SimpleNamespace(integrator="rk4", substeps=4)).settings
        {'substeps': 4}
    """
    settings = {"substeps": config.substeps} if config.substeps > 1 else {}
    return make_integrator(config.integrator, **settings)


def integrator_mapping(integrator: Integrator) -> dict[str, Any]:
    """Write an integrator as plain values; :func:`read_integrator` makes an equal one."""
    return {"name": integrator.name, **integrator.settings}


def read_integrator(mapping: Mapping[str, Any]) -> Integrator:
    """Make the integrator that :func:`integrator_mapping` has written.

    Examples:
        >>> str(read_integrator({"name": "rk4", "substeps": 2}))
        'rk4 (substeps 2)'
    """
    settings = dict(mapping)
    return make_integrator(settings.pop("name"), **settings)


def has_substeps(integrator: str) -> bool:
    """Whether the integrator of that name takes as many steps as it is told."""
    return issubclass(INTEGRATORS[integrator], FixedStepIntegrator)
