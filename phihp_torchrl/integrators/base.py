"""The interface of integrators, and the layout of the states that they integrate."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_count

Derivative = Callable[[Tensor], Tensor]
"""A vector field ``state [*batch, n] -> ds/dt [*batch, n]``, for an action that is held."""
Solver = Callable[[Derivative, Tensor], Tensor]
"""A step of fixed length: ``derivative, state [rows, n] -> next state [rows, n]``."""
Impulse = Callable[[int, Tensor], Tensor]
"""``pair, state [*batch, n] -> [*batch, n]``: how the velocities change, per change of that one."""
TimeStep = float | Tensor
"""Seconds: a number, or a tensor ``[*batch, 1]``."""


@dataclass(frozen=True)
class StateLayout:
    """Which components of a state are positions and velocities, and the limits of both.

    A limit of a velocity holds it back. A limit of a position is a stop: after a solver step that
    ends beyond it, the position is put on the limit, and a velocity that leads further out becomes
    ``-restitution`` times itself. Several stops that are hit in one step act one after the other.

    Args:
        size: number of state components, ``n``.
        pairs: ``(position, velocity)`` index pairs. Components in no pair are first-order.
        limits: one entry per pair, in the unit of the velocity: the largest ``|velocity|`` (``inf``
            for no limit), or the lowest and the highest velocity. The attribute always holds
            (lowest, highest).
        stops: one entry per pair, in the unit of the position: the lowest and the highest position
            (infinite for no stop). Empty for no stops at all.
        restitution: one entry per pair, in [0, 1]: the share of the velocity that a stop gives
            back. Empty for 0, stops without a bounce.
        impulse: how a stop of one pair changes all velocities, as :meth:`coupled` sets it;
            ``None`` if it changes the pair's own alone.

    Raises:
        ConfigError: if there are not as many limits as pairs, a lower limit is not below the
            upper one, or a restitution is out of range.

    Examples:
        >>> layout = StateLayout(size=2, pairs=((0, 1),), limits=(8.0,))
        >>> layout.limited, layout.limits
        (True, ((-8.0, 8.0),))
        >>> rail = StateLayout(2, ((0, 1),), (8.0,), stops=((-1.0, 1.0),), restitution=(0.5,))
        >>> rail.clip(torch.tensor([1.2, 3.0]))
        tensor([ 1.0000, -1.5000])
    """

    size: int
    pairs: tuple[tuple[int, int], ...] = ()
    limits: tuple[Any, ...] = ()
    stops: tuple[tuple[float, float], ...] = ()
    restitution: tuple[float, ...] = ()
    impulse: Impulse | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if len(self.limits) != len(self.pairs):
            raise ConfigError(
                "limits",
                f"expected one per (position, velocity) pair, {len(self.pairs)}, "
                f"got {len(self.limits)}.",
            )
        limits = tuple(tuple(x) if isinstance(x, (tuple, list)) else (-x, x) for x in self.limits)
        if any(len(pair) != 2 or not pair[0] < pair[1] for pair in limits):
            raise ConfigError("limits", f"expected low < high for each velocity, got {limits}.")
        object.__setattr__(self, "limits", limits)
        stops = self.stops or ((-math.inf, math.inf),) * len(self.pairs)
        bounce = self.restitution or (0.0,) * len(self.pairs)
        for name, values in (("stops", stops), ("restitution", bounce)):
            if len(values) != len(self.pairs):
                raise ConfigError(
                    name, f"expected one per pair, {len(self.pairs)}, got {len(values)}."
                )
        if any(len(pair) != 2 or not pair[0] < pair[1] for pair in stops):
            raise ConfigError("stops", f"expected low < high for each position, got {stops}.")
        if not all(0 <= value <= 1 for value in bounce):
            raise ConfigError("restitution", f"expected values in [0, 1], got {bounce}.")
        object.__setattr__(self, "stops", tuple((float(low), float(high)) for low, high in stops))
        object.__setattr__(self, "restitution", tuple(float(value) for value in bounce))

    @property
    def limited(self) -> bool:
        """Whether any velocity has a finite limit."""
        return any(math.isfinite(bound) for pair in self.limits for bound in pair)

    @property
    def stopped(self) -> bool:
        """Whether any position has a finite limit."""
        return any(math.isfinite(bound) for pair in self.stops for bound in pair)

    def coupled(self, impulse: Impulse) -> StateLayout:
        """Return this layout with stops that change other velocities too; itself without stops.

        Args:
            impulse: ``pair, state [*batch, n] -> [*batch, n]``, the change of each component when
                the velocity of that pair changes by 1.
        """
        return replace(self, impulse=impulse) if self.stopped else self

    def clip(self, state: Tensor) -> Tensor:
        """Apply all limits to ``state`` ``[*batch, n]``: of the velocities, then of positions."""
        return self.stop(self._clip_velocities(state))

    def stop(self, state: Tensor) -> Tensor:
        """Apply the limits of positions to ``state`` ``[*batch, n]``."""
        if not self.stopped:
            return state
        for pair, (low, high) in enumerate(self.stops):
            if not (math.isfinite(low) or math.isfinite(high)):
                continue
            q, v = self.pairs[pair]
            columns = list(state.unbind(-1))
            position, velocity = columns[q], columns[v]
            hit = ((position > high) & (velocity > 0)) | ((position < low) & (velocity < 0))
            after = torch.where(hit, -self.restitution[pair] * velocity, velocity)
            columns[q] = position.clamp(low, high)
            if self.impulse is not None:
                along = self.impulse(pair, torch.stack(columns, -1)).unbind(-1)
                for _, other in self.pairs:
                    columns[other] = columns[other] + (after - velocity) * along[other]
            columns[v] = after
            state = torch.stack(columns, -1)
        return self._clip_velocities(state)

    def _clip_velocities(self, state: Tensor) -> Tensor:
        if not self.limited:
            return state
        components = list(state.unbind(-1))
        for (_, velocity), (low, high) in zip(self.pairs, self.limits, strict=True):
            if math.isfinite(low) or math.isfinite(high):
                components[velocity] = components[velocity].clamp(low, high)
        return torch.stack(components, -1)


class Integrator(abc.ABC):
    """Solve ds/dt = f(s) over one control step (paper, section 4.1, equation 2).

    Integrators hold no tensors and no state, so one instance serves every device and dtype. A
    subclass has a ``name`` and implements ``__call__``.

    Examples:
        >>> class Euler(Integrator):
        ...     name = "euler"
        ...
        ...     def __call__(self, derivative, state, time_step, layout):
        ...         return layout.clip(state + time_step * derivative(state))
        >>> Euler()(lambda state: -state, torch.ones(2), 0.1, StateLayout(size=2))
        tensor([0.9000, 0.9000])
    """

    name: ClassVar[str]
    """The name that settings use."""
    compiles: ClassVar[bool] = True
    """Whether ``torch.compile(fullgraph=True)`` accepts a step."""

    @abc.abstractmethod
    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        """Return the state ``time_step`` seconds after ``state`` ``[*batch, n]``, same shape.

        The time step is a number, or a tensor ``[*batch, 1]`` with one for each state.
        """

    def prepared(self, time_step: float, layout: StateLayout, like: Tensor) -> Solver:
        """Return the same step as a function of derivative and state, for many calls.

        A subclass may compute once what does not change from call to call, for states that are
        matrices ``[rows, n]`` of the dtype and on the device of ``like``. Results are those of
        ``__call__`` up to rounding; a row with a component that is not finite may lose the others.
        """
        return lambda derivative, state: self(derivative, state, time_step, layout)

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments that make an equal one: ``make_integrator(name, **settings)``."""
        return dict(vars(self))

    def __str__(self) -> str:
        told = ", ".join(f"{name} {value:g}" for name, value in self.settings.items())
        return f"{self.name} ({told})" if told else self.name


class FixedStepIntegrator(Integrator):
    """A solver that divides each control step into ``substeps`` steps of equal length.

    Args:
        substeps: solver steps in a control step. The time of a call is proportional to it. A model
            of a world that is simulated in smaller steps is most accurate with as many.

    Raises:
        ConfigError: if ``substeps`` is not a positive whole number.
    """

    def __init__(self, substeps: int = 1) -> None:
        self.substeps = substeps
        check_count(self, "substeps")

    def __call__(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        for _ in range(self.substeps):
            state = self.step(derivative, state, time_step / self.substeps, layout)
        return state

    @abc.abstractmethod
    def step(
        self, derivative: Derivative, state: Tensor, time_step: TimeStep, layout: StateLayout
    ) -> Tensor:
        """Return the state one solver step of ``time_step`` seconds later, same shape."""
