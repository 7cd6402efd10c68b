"""What is fitted: a step of the system with constants and an actuator, and its derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from phihp_torchrl.dynamics import PhysicsPrior
from phihp_torchrl.identification.response import respond
from phihp_torchrl.identification.windows import Samples
from phihp_torchrl.integrators import Integrator, StateLayout
from phihp_torchrl.tasks import Actuator, Numbers

PARTS = ("delay_steps", "lag", "slew", "dead_zone", "gain_low")
"""Parts of an actuator that can be fitted, each a number for all actions, or for one of them."""

NEUTRAL = {"lag": 0.0, "dead_zone": 0.0, "gain_low": 1.0}
"""What such a part is where it does nothing."""

_NUDGE = 1e-5
"""Relative size of the differences by which derivatives of the actuator are taken."""
_STEP = 1e-7
"""That of a step's derivatives, to one side, in double precision."""


@dataclass(frozen=True)
class Model:
    """Equations with parameters ``[p]``: first those of the constants, then those of the actuator.

    Args:
        prior: the equations and how their constants follow from parameters.
        layout: positions and velocities of the state, and limits of the velocities.
        integrator: a Runge-Kutta or Euler step with substeps.
        path: the actuator; its fitted parts are overwritten.
        fitted: names of the parts that are fitted: ``"lag"`` for all actions, or
            ``"lag of volts"`` for one.
    """

    prior: PhysicsPrior
    layout: StateLayout
    integrator: Integrator
    path: Actuator
    fitted: tuple[str, ...] = ()

    @property
    def constants(self) -> int:
        """How many parameters are those of constants."""
        return len(self.prior.learned)

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the actions."""
        return self.prior.system.action_names

    def first(self) -> Tensor:
        """Parameters of the first guesses."""
        parts = [_to_raw(part_of(n)[0], self.number(self.path, n)) for n in self.fitted]
        raw = self.prior.log_constants.detach().double()
        return torch.cat([raw, torch.tensor(parts, dtype=raw.dtype)])

    def with_part(self, name: str, value: float, action: int | None = None) -> Model:
        """The same equations, with one more part of the actuator fitted, from a first guess.

        Args:
            name: the part.
            value: its first guess.
            action: the action that it is of; ``None`` for all.
        """
        if action is not None:
            name = f"{name} of {self.actions[action]}"
        return replace(self, fitted=(*self.fitted, name), path=self.put(self.path, name, value))

    def number(self, path: Actuator, name: str) -> float:
        """The number of a fitted part."""
        part, action = part_of(name)
        value: Numbers = getattr(path, part)
        if not isinstance(value, tuple):
            return value
        return value[0 if action is None else self.actions.index(action)]

    def put(self, path: Actuator, name: str, value: float) -> Actuator:
        """An actuator with another number of a fitted part."""
        part, action = part_of(name)
        if action is None:
            return replace(path, **{part: value})
        old = getattr(path, part)
        values = list(old) if isinstance(old, tuple) else [old] * len(self.actions)
        values[self.actions.index(action)] = value
        return replace(path, **{part: tuple(values)})

    def stopping(self, layout: StateLayout, raw: Tensor) -> Model:
        """The same equations in a layout with stops, for constants that stay as they are."""
        system = self.prior.system
        constants = self.prior.decode(raw[: self.constants])
        positions = tuple(system.velocity_of)

        def impulse(pair: int, state: Tensor) -> Tensor:
            return system.impulse(positions[pair], state, constants)

        return replace(self, layout=layout.coupled(impulse))

    def actuator(self, raw: Tensor) -> Actuator:
        """The actuator that belongs to parameters ``[p]``."""
        values = raw[self.constants :].tolist()
        path = self.path
        for name, value in zip(self.fitted, values, strict=True):
            path = self.put(path, name, _from_raw(part_of(name)[0], value))
        return path

    def acting(self, samples: Samples, raw: Tensor) -> Tensor:
        """What acts after each sample, ``[N, m]``."""
        return respond(samples, self.actuator(raw))

    def acting_slopes(self, samples: Samples, raw: Tensor) -> Tensor:
        """Derivatives of :meth:`acting` by the parameters of the actuator, ``[N, m, parts]``."""
        slopes = []
        for i in range(self.constants, len(raw)):
            nudge = torch.zeros_like(raw)
            nudge[i] = 10.0 * _NUDGE
            high, low = self.acting(samples, raw + nudge), self.acting(samples, raw - nudge)
            slopes.append((high - low) / (2.0 * nudge[i]))
        shape = samples.action.shape
        return torch.stack(slopes, -1) if slopes else samples.action.new_zeros(*shape, 0)

    def step(self, raw: Tensor, state: Tensor, acting: Tensor, seconds: Tensor) -> Tensor:
        """The state after ``seconds`` ``[*batch]``: ``[*batch, n], [*batch, m] -> [*batch, n]``.

        Args:
            raw: parameters ``[p]``, or ``[*batch, p]``.
            state: the state before.
            acting: what acts.
            seconds: the duration.
        """
        constants = self.prior.decode(raw[..., : self.constants])
        system = self.prior.system

        def derivative(s: Tensor) -> Tensor:
            return system.prior(s, acting, constants)

        return self.integrator(derivative, state, seconds[..., None], self.layout)

    def slopes(
        self,
        raw: Tensor,
        state: Tensor,
        acting: Tensor,
        seconds: Tensor,
        scale: Tensor,
        *,
        learn: bool = True,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Derivatives of :meth:`step`, by differences to one side, all directions at once.

        Differences in double precision are exact to about seven digits, need nothing of a system
        but its equations, and cost a twentieth of what derivatives of such small operations cost.

        Args:
            raw: parameters ``[p]``.
            state: ``[M, n]``.
            acting: ``[M, m]``.
            seconds: ``[M]``.
            scale: usual sizes of states and actions, ``[n + m]``.
            learn: ``False`` for the derivatives by the state alone; the others are empty.

        Returns:
            By the state ``[M, n, n]``, by the action ``[M, n, m]``, by the parameters of the
            constants ``[M, n, c]``.
        """
        n, m, c = state.shape[-1], acting.shape[-1], self.constants
        size = _STEP * torch.cat([scale, torch.ones(c, dtype=scale.dtype)])
        tried = len(size) if learn else n
        still = torch.zeros_like(size)[None]
        nudges = torch.cat([still, size.diag()[:tried]])[:, None, :]  # [1 + d, 1, -]
        constants = raw[:c]
        if learn:
            constants = (constants + nudges[..., n + m :]).expand(-1, len(state), -1)
            acting = acting + nudges[..., n : n + m]
        seconds = seconds.expand(len(nudges), -1)
        ahead = self.step(constants, state + nudges[..., :n], acting, seconds)
        slopes = ((ahead[1:] - ahead[:1]) / size[:tried, None, None]).permute(1, 2, 0)
        return slopes[..., :n], slopes[..., n : n + m], slopes[..., n + m :]


def part_of(name: str) -> tuple[str, str | None]:
    """The part of an actuator that is fitted, and the action that it is of; ``None`` for all.

    Examples:
        >>> part_of("lag"), part_of("lag of volts")
        (('lag', None), ('lag', 'volts'))
    """
    part, _, action = name.partition(" of ")
    return part, action or None


def _to_raw(name: str, value: float) -> float:
    return value if name == "delay_steps" else math.log(value)


def _from_raw(name: str, value: float) -> float:
    if name == "delay_steps":
        return max(value, 0.0)
    return math.exp(min(max(value, -30.0), 30.0))
