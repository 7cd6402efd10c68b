"""What a physical system declares: its state, its constants, F^p and F^r."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from phihp_torchrl.integrators import StateLayout

Constants = Mapping[str, Any]
"""Physical constants by name: floats, or tensors that broadcast against ``[*batch]``."""


class System:
    """A controlled system ds/dt = F^p(s, a) + F^r(s, a) (paper, section 4.1 and appendix B).

    A subclass declares the names below and writes :meth:`prior`; a system with friction also writes
    :meth:`friction`. One whose equations are not to be known writes :meth:`derivative` instead, and
    only methods that need no prior can learn it. All are pure functions of tensors with any leading
    batch dimensions, so that they differentiate, compile and run in any dtype. The prior is given
    its constants and can not see those of the world; the friction is known to the world alone.

    Args:
        constants: true constants that differ from the declared ones, by name.
        friction_constants: friction coefficients that differ from the declared ones, by name.

    Raises:
        TypeError: for a class that has neither a prior nor a derivative.
        ValueError: for a name that the system does not declare, or a constant that is not positive
            and finite.
    """

    state_names: ClassVar[tuple[str, ...]]
    """Components of the state, in order."""
    action_names: ClassVar[tuple[str, ...]]
    """Components of the action, in order."""
    angles: ClassVar[tuple[str, ...]] = ()
    """State components that live on a circle, in radians."""
    velocity_of: ClassVar[Mapping[str, str]] = {}
    """The velocity that belongs to each position."""
    default_constants: ClassVar[Mapping[str, float]] = {}
    """The constants of F^p, all positive, with the values of SPEC's worlds."""
    default_friction: ClassVar[Mapping[str, float]] = {}
    """The coefficients of F^r, not negative."""

    def __init__(
        self,
        constants: Mapping[str, float] | None = None,
        friction_constants: Mapping[str, float] | None = None,
    ) -> None:
        if not self.has_prior and type(self).derivative is System.derivative:
            raise TypeError(f"{type(self).__name__}: expected a method `prior` or `derivative`.")
        self.constants = _override("constants", self.default_constants, constants)
        self.friction_constants = _override(
            "friction_constants", self.default_friction, friction_constants
        )
        if any(not 0 < value < math.inf for value in self.constants.values()):
            raise ValueError(f"constants: expected positive, finite values, got {self.constants}.")
        if any(not 0 <= value < math.inf for value in self.friction_constants.values()):
            raise ValueError(
                "friction_constants: expected non-negative, finite values, "
                f"got {self.friction_constants}."
            )

    @property
    def has_prior(self) -> bool:
        """Whether F^p is known."""
        return type(self).prior is not System.prior

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        """F^p: the frictionless equations ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        raise NotImplementedError(f"{type(self).__name__}: this system has no prior.")

    def friction(self, state: Tensor, action: Tensor) -> Tensor:
        """F^r of the simulated world: what the prior leaves out, ``[*batch, n]``."""
        return torch.zeros_like(state)

    def identifiable(self, constants: Constants) -> dict[str, Any]:
        """The combinations of constants that the motion determines; by default each by itself."""
        return dict(constants)

    def derivative(self, state: Tensor, action: Tensor) -> Tensor:
        """ds/dt of the real world: F^p with the true constants, and friction, ``[*batch, n]``."""
        return self.prior(state, action, self.constants) + self.friction(state, action)

    # What follows from the declarations.

    @property
    def state_dim(self) -> int:
        """Number of state components, ``n``."""
        return len(self.state_names)

    @property
    def action_dim(self) -> int:
        """Number of action components, ``m``."""
        return len(self.action_names)

    @property
    def observation_dim(self) -> int:
        """Number of observation components: an angle counts twice."""
        return self.state_dim + len(self.angles)

    @property
    def angle_indices(self) -> tuple[int, ...]:
        """Indices of the angles in the state."""
        return tuple(self.state_names.index(name) for name in self.angles)

    @property
    def velocity_indices(self) -> tuple[int, ...]:
        """Indices of the velocities in the state."""
        return tuple(self.state_names.index(name) for name in self.velocity_of.values())

    def layout(self, velocity_limits: Mapping[str, float] | None = None) -> StateLayout:
        """The state's layout for an integrator, with limits on ``|velocity|`` by name."""
        limits = dict.fromkeys(self.velocity_of.values(), float("inf"))
        limits = _override("velocity_limits", limits, velocity_limits)
        index = self.state_names.index
        return StateLayout(
            size=self.state_dim,
            pairs=tuple((index(q), index(v)) for q, v in self.velocity_of.items()),
            limits=tuple(limits[v] for v in self.velocity_of.values()),
        )

    def observe(self, state: Tensor) -> Tensor:
        """Map a state ``[*batch, n]`` to an observation: each angle becomes (cos, sin)."""
        angles = self.angle_indices
        columns: list[Tensor] = []
        for i, component in enumerate(state.unbind(-1)):
            columns += [component.cos(), component.sin()] if i in angles else [component]
        return torch.stack(columns, -1)

    def locate(self, observation: Tensor) -> Tensor:
        """Map an observation back to the state, angles in [-pi, pi]; inverts :meth:`observe`."""
        angles = self.angle_indices
        columns = iter(observation.unbind(-1))
        state: list[Tensor] = []
        for i in range(self.state_dim):
            first = next(columns)
            state.append(torch.atan2(next(columns), first) if i in angles else first)
        return torch.stack(state, -1)

    def difference(self, state: Tensor, other: Tensor) -> Tensor:
        """``state - other`` ``[*batch, n]``, angles on the circle, in [-pi, pi)."""
        delta = list((state - other).unbind(-1))
        for i in self.angle_indices:
            delta[i] = wrap(delta[i])
        return torch.stack(delta, -1)


def wrap(angle: Tensor) -> Tensor:
    """Map angles in radians to [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def _override(
    what: str, defaults: Mapping[str, float], changes: Mapping[str, float] | None
) -> dict[str, float]:
    changes = changes or {}
    unknown = sorted(set(changes) - set(defaults))
    if unknown:
        raise ValueError(f"{what}: unknown {unknown}, expected some of {sorted(defaults)}.")
    return {name: float(changes.get(name, value)) for name, value in defaults.items()}
