"""From ds/dt to the next state: the same solvers for the world and for the model."""

from __future__ import annotations

from phihp_torchrl.integrators.base import Derivative, Integrator, StateLayout
from phihp_torchrl.integrators.dopri5 import Dopri5
from phihp_torchrl.integrators.rk4 import RK4
from phihp_torchrl.integrators.semi_implicit_euler import SemiImplicitEuler

__all__ = [
    "RK4",
    "Derivative",
    "Dopri5",
    "Integrator",
    "SemiImplicitEuler",
    "StateLayout",
    "make_integrator",
]

_INTEGRATORS: dict[str, type[Integrator]] = {
    "semi_implicit_euler": SemiImplicitEuler,
    "rk4": RK4,
    "dopri5": Dopri5,
}


def make_integrator(integrator: str | Integrator) -> Integrator:
    """Return the integrator of that name; an instance passes through.

    Args:
        integrator: ``"semi_implicit_euler"``, ``"rk4"``, ``"dopri5"`` or an :class:`Integrator`.

    Raises:
        ValueError: for a name that is not one of these.

    Examples:
        >>> type(make_integrator("rk4")).__name__
        'RK4'
    """
    if isinstance(integrator, Integrator):
        return integrator
    if integrator not in _INTEGRATORS:
        raise ValueError(f"integrator: expected one of {sorted(_INTEGRATORS)}, got {integrator!r}.")
    return _INTEGRATORS[integrator]()
