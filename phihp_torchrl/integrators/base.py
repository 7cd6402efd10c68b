"""The interface of integrators, and the layout of the states that they integrate."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_count

Derivative = Callable[[Tensor], Tensor]
"""A vector field ``state [*batch, n] -> ds/dt [*batch, n]``, for an action that is held."""
TimeStep = float | Tensor
"""Seconds: a number, or a tensor ``[*batch, 1]``."""


@dataclass(frozen=True)
class StateLayout:
    """Which components of a state are positions and velocities, and the limits of the velocities.

    Args:
        size: number of state components, ``n``.
        pairs: ``(position, velocity)`` index pairs. Components in no pair are first-order.
        limits: one entry per pair, in the unit of the velocity: the largest ``|velocity|`` (``inf``
            for no limit), or the lowest and the highest velocity. The attribute always holds
            (lowest, highest).

    Raises:
        ConfigError: if there are not as many limits as pairs, or a lower limit is not below the
            upper one.

    Examples:
        >>> layout = StateLayout(size=2, pairs=((0, 1),), limits=(8.0,))
        >>> layout.limited, layout.limits
        (True, ((-8.0, 8.0),))
    """

    size: int
    pairs: tuple[tuple[int, int], ...] = ()
    limits: tuple[Any, ...] = ()

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

    @property
    def limited(self) -> bool:
        """Whether any velocity has a finite limit."""
        return any(math.isfinite(bound) for pair in self.limits for bound in pair)

    def clip(self, state: Tensor) -> Tensor:
        """Clip the velocities of ``state`` ``[*batch, n]`` to their limits."""
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

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments that make an equal one: ``make_integrator(name, **settings)``."""
        return dict(vars(self))


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
