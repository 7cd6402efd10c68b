"""Plants: the true constants and the friction of a simulated world, unknown to models."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import PRIORS
from phihp_torchrl.systems import System, override


class Plant:
    r"""The equations of a simulated world: F^p with the true constants, and friction.

    .. math:: \frac{ds}{dt} = F^p(s, a; \theta^*) + F^r(s, a)

    A subclass implements :meth:`friction`, and :func:`register_plant` sets the system that it
    simulates. A plant whose equations are not F^p plus friction implements :meth:`derivative`
    instead. A system without a registered plant is simulated by F^p without friction.

    Args:
        system: the system, with its names and F^p.
        constants: true constants that differ from the system's first guesses, by name.
        coefficients: friction coefficients that differ from ``default_coefficients``, by name.

    Raises:
        ConfigError: for an unknown name, a value that is not finite, a free constant that is not
            positive, a negative coefficient, or a system without equations.

    Examples:
        >>> from phihp_torchrl.systems import Pendulum
        >>> plant = find_plant(Pendulum(), constants={"mass": 2.0})
        >>> plant.derivative(torch.tensor([0.0, 1.0]), torch.zeros(1))
        tensor([ 1.0000, -0.2500])
    """

    default_coefficients: ClassVar[Mapping[str, float]] = {}
    """The friction coefficients by name, none of them negative."""

    def __init__(
        self,
        system: System,
        constants: Mapping[str, float] | None = None,
        coefficients: Mapping[str, float] | None = None,
    ) -> None:
        if not system.has_prior and type(self).derivative is Plant.derivative:
            raise ConfigError(
                "system",
                f"{type(system).__name__} has no prior, so a world of it can be simulated only by "
                "a Plant with a method `derivative` (register_plant).",
            )
        self.system = system
        self.constants = override("constants", system.constants, constants)
        self.coefficients = override("coefficients", self.default_coefficients, coefficients)
        for what, values in (("constants", self.constants), ("coefficients", self.coefficients)):
            for name, value in values.items():
                if not math.isfinite(value):
                    raise ConfigError(f"{what}.{name}", f"expected a finite value, got {value}.")
        for name, value in self.coefficients.items():
            if value < 0:
                raise ConfigError(f"coefficients.{name}", f"expected a value >= 0, got {value}.")
        for name, constant in system.ranges.items():
            free = not (constant.fixed or constant.bounded)
            if free and self.constants[name] <= 0:
                raise ConfigError(
                    f"constants.{name}", f"expected a positive value, got {self.constants[name]}."
                )

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        """F^r, the part that the prior leaves out: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return torch.zeros_like(state)

    def derivative(self, state: Tensor, action: Tensor) -> Tensor:
        """The true ds/dt: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return self.system.prior(state, action, self.constants) + self.friction(state, action)

    def impulse(self, pair: int, state: Tensor) -> Tensor:
        """How a stop changes all velocities: see :meth:`System.impulse`, by the pair's number."""
        position = tuple(self.system.velocity_of)[pair]
        return self.system.impulse(position, state, self.constants)


class PlantPhysics(nn.Module):
    """The true ds/dt as a module in the place of a prior, for the oracle's model.

    Args:
        plant: the plant.
    """

    kind = "plant"

    def __init__(self, plant: Plant) -> None:
        super().__init__()
        self.plant = plant

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_config` builds it again."""
        return {
            "kind": self.kind,
            "constants": dict(self.plant.constants),
            "coefficients": dict(self.plant.coefficients),
        }

    @classmethod
    def from_config(cls, system: System, config: Mapping[str, Any]) -> PlantPhysics:
        """Build it from :attr:`config`, with the plant that is registered for ``system``."""
        return cls(find_plant(system, config.get("constants"), config.get("coefficients")))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """ds/dt: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return self.plant.derivative(state, action)

    def impulse(self, pair: int, state: Tensor) -> Tensor:
        """How a stop changes all velocities, as :meth:`Plant.impulse`."""
        return self.plant.impulse(pair, state)


PRIORS.register(PlantPhysics.kind, PlantPhysics)

_PLANTS: dict[type[System], type[Plant]] = {}


def register_plant(system: type[System], plant: type[Plant]) -> type[Plant]:
    """Register ``plant`` for simulating ``system`` and its subclasses; returns ``plant``.

    A later registration for the same system replaces an earlier one.

    Args:
        system: class of the system.
        plant: class of the plant.

    Examples:
        >>> class Swing(System):
        ...     state_names, action_names = ("angle", "speed"), ("push",)
        >>> class SwingPlant(Plant):
        ...     def derivative(self, state, action):
        ...         return torch.stack([state[..., 1], action[..., 0] - state[..., 0].sin()], -1)
        >>> type(find_plant(register_plant(Swing, SwingPlant) and Swing())).__name__
        'SwingPlant'
    """
    _PLANTS[system] = plant
    return plant


def find_plant(
    system: System,
    constants: Mapping[str, float] | None = None,
    coefficients: Mapping[str, float] | None = None,
) -> Plant:
    """Make the plant that is registered for a system, or else one of F^p without friction.

    Args:
        system: the system.
        constants: true constants that differ from the system's first guesses, by name.
        coefficients: friction coefficients that differ from the declared ones, by name.

    Raises:
        ConfigError: as :class:`Plant`.

    Examples:
        >>> from phihp_torchrl.systems import CartPole
        >>> find_plant(CartPole(), coefficients={"cart": 0.3}).coefficients
        {'cart': 0.3, 'pole': 0.02}
    """
    kinds = (_PLANTS[kind] for kind in type(system).__mro__ if kind in _PLANTS)
    return next(kinds, Plant)(system, constants, coefficients)
