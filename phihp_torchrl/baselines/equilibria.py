"""Where a model rests, for each value of a task's reference."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.point import DRIFT, LinearModel, exact_step, trim
from phihp_torchrl.baselines.reference import followed
from phihp_torchrl.config import ConfigError

_NODES = 8
"""Values from the middle of a range to either end at which a rest is sought."""
_HALVINGS = 6
"""How often the way to the next value is halved where the model does not rest there."""

_SHORT = 1e-6
"""The most motion in one step, in half-ranges, in which an action on its bound suffices."""

_log = logging.getLogger(__name__)

Rest = tuple[Tensor, Tensor]
"""A state at rest ``[n]`` and the action ``[m]`` that keeps it."""


@dataclass(frozen=True)
class Equilibria:
    """Rests of a model along each component of a reference, as tables around a linear model.

    Between two values of a table a rest is interpolated. Beyond the last one at which the model
    rests, the reference counts as that one. Where several components of a reference differ from
    those of the point, their shifts add up, which is exact for a linear model.

    Args:
        point: the linear model.
        values: values of each component at which the model rests, rising, float64 ``[N]``.
        shifts: the state and the action at rest less those of the point, ``[N, n + m]``.
    """

    point: LinearModel
    values: tuple[Tensor, ...]
    shifts: tuple[Tensor, ...]

    def at(self, reference: Tensor) -> tuple[Tensor, Tensor]:
        """The state of the task ``[*batch, N]`` and the action ``[*batch, m]`` at rest.

        Args:
            reference: the reference, ``[*batch, k]``.
        """
        task, base = self.point.task, _joined(self.point)
        total = base.to(reference).expand(*reference.shape[:-1], -1)
        for values, shifts, wanted in zip(
            self.values, self.shifts, reference.unbind(-1), strict=True
        ):
            values, shifts = values.to(reference), shifts.to(reference)
            wanted = wanted.clamp(values[0], values[-1])
            above = torch.searchsorted(values, wanted.contiguous()).clamp(1, len(values) - 1)
            low, high = values[above - 1], values[above]
            part = ((wanted - low) / (high - low)).unsqueeze(-1)
            total = total + torch.lerp(shifts[above - 1], shifts[above], part)
        state, action = total.split([task.system.state_dim, task.action_dim], -1)
        action = task.clip_action(action)
        return torch.cat([state, task.registers.rest(action)], -1), action


def find_equilibria(point: LinearModel, dynamics: nn.Module) -> Equilibria:
    """Find them by a few Newton steps at each value, from the rest at the value before.

    Args:
        point: the linear model at the middle of the reference.
        dynamics: the model, ``(state, action) -> next state``.

    Raises:
        ConfigError: where the model rests at no other value of a component than that of the point.
    """
    task, step, size = point.task, exact_step(dynamics), point.task.system.state_dim
    assert task.reference is not None
    places, base = followed(task), _joined(point)
    free = [i for i in range(size) if i not in places.values()]
    every_value, every_shift = [], []
    for name, low, high in zip(places, task.reference.low, task.reference.high, strict=True):
        place = places[name]

        def rest(state: Tensor, value: float, place: int = place) -> Rest | None:
            start = state.index_fill(0, torch.tensor([place]), value)
            found, action, drift = trim(task, step, start, free)
            # A slow model drifts little in a step even where the action falls far short.
            bounded = (task.bounds.to_unit(action).abs() > 1.0 - _SHORT).any()
            return None if drift > (_SHORT if bounded else DRIFT) else (found, action)

        own = point.state[place].item()
        below, above = (_walk(rest, point.state[:size], own, end) for end in (low, high))
        rests = {**dict(reversed(below.items())), own: (point.state[:size], point.action), **above}
        if len(rests) == 1:
            raise ConfigError(
                "reference",
                f"expected one at which the model can rest, but of {name!r} it rests at "
                f"{own:.3g} alone, and not towards {low:.3g} nor {high:.3g}.",
            )
        first, *_, last = rests
        if (first, last) != (low, high):
            _log.info("The model rests at a %s from %.3g to %.3g alone.", name, first, last)
        every_value.append(torch.tensor(list(rests)).double())
        every_shift.append(torch.stack([torch.cat(found) for found in rests.values()]) - base)
    return Equilibria(point, tuple(every_value), tuple(every_shift))


def _walk(
    rest: Callable[[Tensor, float], Rest | None], state: Tensor, own: float, end: float
) -> dict[float, Rest]:
    """Rests by their values, from one's own towards an end, as far as there are any."""
    found: dict[float, Rest] = {}
    value, step, halvings = own, (end - own) / _NODES, 0
    while value != end and halvings <= _HALVINGS:
        ahead = value + step
        ahead = end if abs(end - ahead) < 1e-6 * abs(end - own) else ahead
        if (rested := rest(state, ahead)) is None:
            step, halvings = step / 2.0, halvings + 1
        else:
            value, state, found[ahead] = ahead, rested[0], rested
    return found


def _joined(point: LinearModel) -> Tensor:
    """Physical components of the point's state, and its action, ``[n + m]``."""
    return torch.cat([point.state[: point.task.system.state_dim], point.action])
