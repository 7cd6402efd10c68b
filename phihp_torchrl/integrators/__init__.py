"""Integrators from ds/dt to the next state, the same for simulated worlds and for models."""

from __future__ import annotations

from typing import Any

from phihp_torchrl.config import ConfigError, Registry
from phihp_torchrl.integrators.base import Derivative, FixedStepIntegrator, Integrator, StateLayout
from phihp_torchrl.integrators.dopri5 import Dopri5
from phihp_torchrl.integrators.rk4 import RK4
from phihp_torchrl.integrators.semi_implicit_euler import SemiImplicitEuler

__all__ = ["RK4", "Dopri5", "Integrator", "SemiImplicitEuler", "StateLayout", "make_integrator"]

INTEGRATORS: Registry[type[Integrator]] = Registry("integrator")
"""Integrators by the name that settings use."""

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
