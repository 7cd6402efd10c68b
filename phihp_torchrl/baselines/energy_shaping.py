"""Swing-up by energy shaping, with a regulator that catches the system at the top."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.catch import find_catch
from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.energy import Energy, find_energy
from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.baselines.point import physical_step
from phihp_torchrl.config import ConfigError, check_fields, check_not_negative, check_positive
from phihp_torchrl.tasks import Task


@dataclass(frozen=True)
class PumpConfig:
    """How energy is pumped.

    Args:
        gain: share of the full action for each share of the energy that is missing; at most all.
        excess: energy to aim for over that at rest upright, as a share of the difference from
            hanging to upright, for what friction takes on the way.
        cart_reach: share of the cart's largest acceleration that pumps.
        cart_stiffness: pull of the cart to the middle, in 1/s².
        cart_damping: brake of the cart, in 1/s.

    Raises:
        ConfigError: for a number that is not positive; the message names it.
    """

    gain: float = 10.0
    excess: float = 0.0
    cart_reach: float = 1.0
    cart_stiffness: float = 4.0
    cart_damping: float = 2.0

    def __post_init__(self) -> None:
        check_fields(self)
        check_positive(self, "gain", "cart_reach")
        check_not_negative(self, "excess", "cart_stiffness", "cart_damping")


class EnergyShaping(Controller):
    r"""Swing-up of a pendulum, a pole on a cart or a two-link arm by energy, with an LQR on top.

    An action along the power of each joint raises the energy E to that upright, and one against it
    lowers it (Åström and Furuta, 2000, https://doi.org/10.1016/S0005-1098(99)00140-5; for the arm
    with both joints along their velocities, Spong, 1995, https://doi.org/10.1109/37.341864):

    .. math:: u = u_{max}\, \mathrm{clip}(k (E_{up} - E) / \Delta E, -1, 1)\, \mathrm{sign}(p)

    A cart's force is the one that gives it this acceleration in the model, and a pull to the middle
    on top. Where the cost-to-go of the :class:`LQR` is below the level from which the model showed
    that the clipped regulator arrives, the regulator acts.

    Constants are those that the model has learned. It ignores friction but for ``excess``, and dead
    time and lag of an actuator while it pumps.

    Args:
        task: a task on ``Pendulum``, ``CartPole`` or ``Acrobot``.
        dynamics: the model, with a prior.
        lqr: the regulator at the top; ``None`` to pump alone, as for a task that ends at a height.
        level: cost-to-go below which the regulator acts.
        config: how to pump.

    Raises:
        ConfigError: for another system, and a model without constants.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum-swingup")
        >>> swing = EnergyShaping.from_model(task, HybridDynamics.pure_prior(task))
        >>> hanging = task.observe(torch.tensor([torch.pi, 0.1]))
        >>> swing(TensorDict(observation=hanging))["action"]  # along its velocity
        tensor([2.])
    """

    def __init__(
        self,
        task: Task,
        dynamics: nn.Module,
        *,
        lqr: LQR | None,
        level: float = 0.0,
        config: PumpConfig | None = None,
    ) -> None:
        super().__init__(task)
        found = find_energy(task, dynamics)
        if found is None:
            raise ConfigError(
                "dynamics",
                "expected a model with constants of a Pendulum, CartPole or Acrobot, got "
                f"{type(dynamics).__name__} of {type(task.system).__name__}.",
            )
        self.energy: Energy = found[0]
        self.constants: dict[str, Any] = found[1]
        self.dynamics = dynamics
        self.lqr = lqr
        self.level = level
        self.config = config or PumpConfig()

    @classmethod
    def from_model(
        cls, task: Task, dynamics: nn.Module, config: PumpConfig | None = None
    ) -> EnergyShaping:
        """Build it for a task in a model, with a regulator where the task has a goal.

        Args:
            task: the task.
            dynamics: the model, with a prior.
            config: how to pump.

        Raises:
            ConfigError: as the class.
        """
        try:
            lqr, level = find_catch(task, dynamics)
        except ConfigError:  # there is no goal to stay in
            return cls(task, dynamics, lqr=None, config=config)
        return cls(task, dynamics, lqr=lqr, level=level, config=config)

    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        physical = self.task.split(state)[0]
        action = self._pump(physical)
        if self.lqr is None:
            return action
        near = (self.lqr.value(state) < self.level).unsqueeze(-1)
        return torch.where(near, self.lqr.act(state), action)

    def _pump(self, state: Tensor) -> Tensor:
        """The action ``[*batch, m]`` that brings the energy towards that upright."""
        config = self.config
        missing = config.excess - self.energy.height(state, self.constants)
        power = self.energy.power(state, self.constants)
        power = power[..., power.shape[-1] - (1 if self.energy.carried else self.task.action_dim) :]
        push = (config.gain * missing).clamp(-1.0, 1.0).unsqueeze(-1)
        share = torch.where(power >= 0, push, -push)
        if self.energy.carried:
            return self._carry(state, share)
        bounds = self.task.bounds.to(state.device)
        return (bounds.center + bounds.scale * share).to(state)

    def _carry(self, state: Tensor, share: Tensor) -> Tensor:
        """The force that accelerates the cart by a share of the most that it can."""
        config, task = self.config, self.task
        bounds = task.bounds.to(state.device)
        middle = bounds.center.to(state).expand(*state.shape[:-1], -1)
        step = physical_step(self.dynamics)
        velocity = task.system.state_names.index("x_dot")
        speeds = [
            step(state, middle + bounds.scale.to(state) * u)[..., velocity] for u in (0.0, 1.0)
        ]
        free = (speeds[0] - state[..., velocity]) / task.time_step
        most = (speeds[1] - speeds[0]) / task.time_step
        wanted = config.cart_reach * most * share[..., 0]
        wanted = wanted - config.cart_stiffness * state[..., velocity - 1]
        wanted = wanted - config.cart_damping * state[..., velocity]
        return middle + bounds.scale.to(state) * ((wanted - free) / most).unsqueeze(-1)
