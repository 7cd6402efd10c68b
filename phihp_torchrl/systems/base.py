"""A controlled system as far as it is known: names, geometry, equations F^p and first guesses."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, plain, plain_fields
from phihp_torchrl.integrators import StateLayout
from phihp_torchrl.systems.layout import make_layout

Constants = Mapping[str, Any]
"""Physical constants by name: floats, or tensors that broadcast against ``[*batch]``."""


@dataclass(frozen=True)
class Constant:
    """A first guess of a physical constant, and the range in which it is learned.

    A constant is free (the default: any positive number), bounded (any number between ``low`` and
    ``high``, which may be negative) or fixed (known, and not learned).

    Args:
        guess: the first guess, in the unit of the constant.
        low: lower limit, exclusive.
        high: upper limit, exclusive; infinite for none, which requires ``low`` = 0.
        fixed: whether the guess is known to be the value, which is then not learned.

    Raises:
        ConfigError: for a guess that is not finite or not between the limits, and for a lower limit
            other than 0 without an upper one.

    Examples:
        >>> Constant(9.81, fixed=True)
        Constant(guess=9.81, low=0.0, high=inf, fixed=True)
        >>> Constant(0.0, low=-0.2, high=0.2).bounded
        True
    """

    guess: float
    low: float = 0.0
    high: float = math.inf
    fixed: bool = False

    def __post_init__(self) -> None:
        plain_fields(self)
        if not all(isinstance(each, (int, float)) for each in (self.guess, self.low, self.high)):
            raise ConfigError("guess", f"expected numbers, got {self}.")
        if not (math.isfinite(self.guess) and math.isfinite(self.low)):
            raise ConfigError("guess", f"expected finite numbers, got {self}.")
        if self.high == math.inf and self.low != 0.0 and not self.fixed:
            raise ConfigError("high", f"expected a finite limit above low={self.low}, got none.")
        if not self.fixed and not self.low < self.guess < self.high:
            raise ConfigError(
                "guess", f"expected a value between {self.low} and {self.high}, got {self.guess}."
            )

    @property
    def bounded(self) -> bool:
        """Whether there is an upper limit."""
        return math.isfinite(self.high)


class System:
    """What is known of a system whose state follows ds/dt = F^p(s, a) + F^r(s, a).

    A subclass declares the names below and implements :meth:`prior`, the known part F^p (paper,
    section 4.1). It contains neither friction nor true values of the constants: a model learns
    them from data, and a *simulated* world has them in its
    :class:`~phihp_torchrl.worlds.Plant`. A system whose equations are unknown does not implement
    :meth:`prior`; methods without a prior can still learn it.

    All functions are pure functions of tensors with any leading batch dimensions, without ``if`` on
    values and without ``.item()``, so that they differentiate, compile and run in any dtype.

    Args:
        constants: first guesses that differ from the declared ones, by name.

    Raises:
        ConfigError: for a name that the system does not declare, or a guess out of its limits.

    Examples:
        >>> class Cart(System):
        ...     state_names, action_names = ("x", "x_dot"), ("force",)
        ...     velocity_of = {"x": "x_dot"}
        ...     default_constants = {"mass": 2.0}
        ...
        ...     def prior(self, state, action, constants):
        ...         return torch.stack([state[..., 1], action[..., 0] / constants["mass"]], -1)
        >>> cart = Cart(constants={"mass": 1.5})
        >>> cart.prior(torch.zeros(4, 2), torch.ones(4, 1), cart.constants).shape
        torch.Size([4, 2])
    """

    state_names: ClassVar[tuple[str, ...]]
    """Components of the state, in order."""
    action_names: ClassVar[tuple[str, ...]]
    """Components of the action, in order."""
    input_names: ClassVar[tuple[str, ...]] = ()
    """What acts besides the actions and is measured, such as wind; behind them in ``action``."""
    angles: ClassVar[tuple[str, ...]] = ()
    """State components that live on a circle, in radians; observed as cosine and sine."""
    velocity_of: ClassVar[Mapping[str, str]] = {}
    """The velocity that belongs to each position."""
    default_constants: ClassVar[Mapping[str, float | Constant]] = {}
    """First guesses of the constants of F^p; a plain number is a free :class:`Constant`."""

    def __init__(self, constants: Mapping[str, float] | None = None) -> None:
        self.ranges = {
            name: value if isinstance(value, Constant) else self._checked(name, Constant, value)
            for name, value in self.default_constants.items()
        }
        self._guess(constants)

    @property
    def constants(self) -> dict[str, float]:
        """The first guesses by name."""
        return {name: constant.guess for name, constant in self.ranges.items()}

    def with_constants(self, constants: Mapping[str, float]) -> System:
        """Return a copy of this system with other first guesses, by name.

        Raises:
            ConfigError: for a name that the system does not declare, or a guess out of its limits.
        """
        other = copy.copy(self)
        other._guess(constants)
        return other

    def _guess(self, constants: Mapping[str, float] | None) -> None:
        guesses = override("constants", self.constants, constants)
        ranges = self.ranges.items()
        self.ranges = {n: self._checked(n, replace, c, guess=guesses[n]) for n, c in ranges}

    @property
    def has_prior(self) -> bool:
        """Whether the system implements F^p."""
        return type(self).prior is not System.prior

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        """F^p, the known part of ds/dt: ``[*batch, n], [*batch, m] -> [*batch, n]``.

        Args:
            state: states in the order of :attr:`state_names`.
            action: actions in physical units, and behind them the inputs if the system has some.
            constants: current values of the constants, by name.
        """
        raise NotImplementedError(f"{type(self).__name__}: this system has no prior.")

    def impulse(self, position: str, state: Tensor, constants: Constants) -> Tensor:
        """How a stop of one position changes all velocities, per change of that position's own.

        A cart that a wall stops passes a blow to the pole on it. This is the direction of that
        change, a column of the inverse mass matrix scaled to 1 in the velocity of ``position``.

        Args:
            position: name of the position that is stopped.
            state: states ``[*batch, n]``, with the position on its limit.
            constants: current values of the constants, by name.

        Returns:
            The change of each component of the state, ``[*batch, n]``. By default a stop changes
            the position's own velocity alone.
        """
        own = self.state_names.index(self.velocity_of[position])
        zero, one = torch.zeros_like(state[..., 0]), torch.ones_like(state[..., 0])
        return torch.stack([one if i == own else zero for i in range(self.state_dim)], -1)

    def identifiable(self, constants: Constants) -> dict[str, Any]:
        """The combinations of constants that the motion determines; by default each constant."""
        return dict(constants)

    # Properties and maps that follow from the declarations.

    @property
    def state_dim(self) -> int:
        """Number of state components, ``n``."""
        return len(self.state_names)

    @property
    def action_dim(self) -> int:
        """Number of action components, ``m``."""
        return len(self.action_names)

    @property
    def acting_dim(self) -> int:
        """Number of components that act on the system: its actions and its inputs."""
        return self.action_dim + len(self.input_names)

    @property
    def observation_dim(self) -> int:
        """Number of observation components, ``o``: an angle counts twice."""
        return self.state_dim + len(self.angles)

    @property
    def angle_indices(self) -> tuple[int, ...]:
        """Indices of the angles in the state."""
        return tuple(self.state_names.index(name) for name in self.angles)

    @property
    def velocity_indices(self) -> tuple[int, ...]:
        """Indices of the velocities in the state."""
        return tuple(self.state_names.index(name) for name in self.velocity_of.values())

    def layout(
        self,
        velocity_limits: Mapping[str, float | tuple[float, float]] | None = None,
        position_limits: Mapping[str, tuple[float, float]] | None = None,
        restitution: float | Mapping[str, float] = 0.0,
    ) -> StateLayout:
        """Return the layout of the state for an integrator.

        Args:
            velocity_limits: limits by the velocity's name: the largest ``|velocity|``, or the
                lowest and the highest velocity.
            position_limits: stops by the position's name: the lowest and the highest position.
            restitution: the share of its velocity with which a position leaves a stop, in [0, 1];
                one number for all, or by the position's name.

        Raises:
            ConfigError: for a name that is not a velocity or a position with stops, for limits in
                the wrong order, and for stops of an angle beyond half a turn, where an observation
                does not tell on which side of a stop it is.
        """
        return make_layout(self, velocity_limits or {}, position_limits or {}, restitution)

    def observe(self, state: Tensor) -> Tensor:
        """Map a state ``[*batch, n]`` to an observation ``[*batch, o]``: angles as (cos, sin)."""
        angles = self.angles
        columns: list[Tensor] = []
        for name, component in zip(self.state_names, state.unbind(-1), strict=True):
            columns += [component.cos(), component.sin()] if name in angles else [component]
        return torch.stack(columns, -1)

    def feature_columns(self) -> list[int]:
        """Where :meth:`observe` is among cosines, sines and values of all components, ``[3 n]``.

        Examples:
            >>> from phihp_torchrl.systems import Pendulum
            >>> state = torch.tensor([0.5, 2.0])  # an angle, and its velocity
            >>> features = torch.cat([state.cos(), state.sin(), state])
            >>> columns = Pendulum().feature_columns()
            >>> columns, torch.equal(features[columns], Pendulum().observe(state))
            ([0, 2, 5], True)
        """
        n, angles = self.state_dim, self.angle_indices
        return [k for i in range(n) for k in ((i, n + i) if i in angles else (2 * n + i,))]

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
        """``state - other`` ``[*batch, n]``, with differences of angles in [-pi, pi)."""
        delta = list((state - other).unbind(-1))
        for i in self.angle_indices:
            delta[i] = wrap(delta[i])
        return torch.stack(delta, -1)

    @staticmethod
    def _checked(name: str, make: Callable[..., Constant], *args: Any, **options: Any) -> Constant:
        """A constant, or an error by its name."""
        try:
            return make(*args, **options)
        except ConfigError as error:
            raise ConfigError(f"constants.{name}", error.reason) from error


def wrap(angle: Tensor) -> Tensor:
    """Map angles in radians to [-pi, pi), ``[*batch] -> [*batch]``.

    Examples:
        >>> wrap(torch.tensor([3.5, -7.0]))
        tensor([-2.7832, -0.7168])
    """
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def override(
    what: str, defaults: Mapping[str, float], changes: Mapping[str, float] | None
) -> dict[str, float]:
    """Return named numbers with some of them changed; an unknown name is an error of ``what``."""
    changes = changes or {}
    unknown = sorted(set(changes) - set(defaults))
    if unknown:
        raise ConfigError(what, f"unknown {unknown}, expected some of {sorted(defaults)}.")
    for name, value in changes.items():
        if isinstance(plain(value), bool) or not isinstance(plain(value), (int, float)):
            raise ConfigError(f"{what}.{name}", f"expected a number, got {value!r}.")
    return {name: float(changes.get(name, value)) for name, value in defaults.items()}
