"""Energies of the package's systems, and the power that an action puts into them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.systems import Acrobot, CartPole, Pendulum
from phihp_torchrl.tasks import Task

Constants = dict[str, Any]
"""Identifiable constants, or constants, of a system by name; scalars."""


@dataclass(frozen=True)
class Energy:
    """What swings a system up: its energy without friction, and how actions change it.

    Args:
        height: the energy over that at rest upright, in units of the difference from hanging to
            upright: ``(state [*batch, n], constants) -> [*batch]``, -1 at rest hanging.
        power: the change of energy per unit of each action, in any positive unit:
            ``(state, constants) -> [*batch, m]``.
        carried: whether a cart carries the pendulum, whose acceleration takes the action's place
            in ``power``.
    """

    height: Callable[[Tensor, Constants], Tensor]
    power: Callable[[Tensor, Constants], Tensor]
    carried: bool = False


def find_energy(task: Task, dynamics: nn.Module | None = None) -> tuple[Energy, Constants] | None:
    """The energy of a task's system with the model's constants; ``None`` where there is none.

    A model without a prior, and a system that is none of the package's, have none. Without a model
    the constants are first guesses.
    """
    system = task.system
    found = next((energy for kind, energy in _ENERGIES.items() if isinstance(system, kind)), None)
    if found is None:
        return None
    if dynamics is None:
        return found, system.identifiable(system.constants)
    constants = getattr(getattr(dynamics, "prior", None), "constants", None)
    if constants is None:
        return None
    with torch.no_grad():
        values = system.identifiable(constants())
    return found, {name: float(value) for name, value in values.items()}


def starts_low(task: Task) -> bool:
    """Whether a task's episodes may start with less than half of the energy upright.

    A task with inputs, whose power is unknown here, counts as none.
    """
    found = find_energy(task)
    if found is None or task.inputs is not None:
        return False
    energy, constants = found
    box = task.reset
    starts = box.sample([256], generator=torch.Generator().manual_seed(0))
    return bool(energy.height(starts, constants).min() < -0.5)


def _pendulum_height(state: Tensor, c: Constants) -> Tensor:
    theta, omega = state.unbind(-1)
    return (0.5 * omega.square() / c["gravity_gain"] + theta.cos() - 1.0) / 2.0


def _pendulum_power(state: Tensor, c: Constants) -> Tensor:
    return state[..., 1:2]


def _pole_height(state: Tensor, c: Constants) -> Tensor:
    """Of a uniform pole seen from its cart: its frequency is sqrt(3 g / 4 l) for small swings."""
    _, _, theta, omega = state.unbind(-1)
    pull = 0.75 * c["gravity"] / c["half_length"]
    return (0.5 * omega.square() / pull + theta.cos() - 1.0) / 2.0


def _pole_power(state: Tensor, c: Constants) -> Tensor:
    """By the cart's acceleration, which pushes the pole back."""
    return -(state[..., 3:4] * state[..., 2:3].cos())


def _arm_height(state: Tensor, c: Constants) -> Tensor:
    theta1, theta2, omega1, omega2 = state.unbind(-1)
    coupled = c["coupling"] * theta2.cos()
    m11 = c["inertia_a"] + c["inertia_b"] + 2.0 * coupled
    m12 = c["inertia_b"] + coupled
    moving = (
        0.5 * (m11 * omega1.square() + c["inertia_b"] * omega2.square()) + m12 * omega1 * omega2
    )
    high = c["weight1"] + c["weight2"]
    lifted = -c["weight1"] * theta1.cos() - c["weight2"] * (theta1 + theta2).cos()
    return (moving + lifted - high) / (2.0 * high)


def _arm_power(state: Tensor, c: Constants) -> Tensor:
    """Of torques on both joints; a system that drives the elbow alone takes the last."""
    return state[..., 2:4]


_ENERGIES: dict[type, Energy] = {
    Pendulum: Energy(_pendulum_height, _pendulum_power),
    CartPole: Energy(_pole_height, _pole_power, carried=True),
    Acrobot: Energy(_arm_height, _arm_power),
}
