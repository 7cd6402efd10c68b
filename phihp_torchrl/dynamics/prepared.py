"""A world model for one plan: what does not change from step to step is computed once."""

from __future__ import annotations

import copy
from collections.abc import Callable
import torch
from torch import Tensor, nn

from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.prior import PhysicsPrior
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task, Transition

Derivative = Callable[[Tensor, Tensor], Tensor]


class PreparedModel:
    """The functions of a :class:`TaskWorldModel` in fewer and larger operations, up to rounding.

    It is made anew for each plan, because it reads the weights as they are then. States are
    matrices ``[rows, n]``, and nothing is differentiated. Beside the functions of a world model it
    has a step in two halves: :meth:`advance` moves the state, and :meth:`judge` gives rewards and
    ends of many steps at once.

    Without gradients and graphs, the time of a plan of some hundred rows is that of calling
    operations, not of their arithmetic. So the constants of the equations are computed once, scales
    are part of the residual's layers, and an observation that actor, value and residual read is
    computed once.

    Args:
        task: the task.
        dynamics: a module ``(state, action) -> next state``.
        like: a tensor of the dtype and on the device of the states.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum")
        >>> dynamics = HybridDynamics.hybrid(task)
        >>> state, action = torch.tensor([[0.5, 1.0]]), torch.tensor([[2.0]])
        >>> with torch.no_grad():
        ...     _, found = PreparedModel(task, dynamics, like=state).advance(state, action)
        ...     torch.allclose(found, dynamics(state, action))
        True
    """

    def __init__(self, task: Task, dynamics: nn.Module, like: Tensor) -> None:
        self.task = task
        self._seen: tuple[Tensor, Tensor] | None = None
        self._step = self._make_step(dynamics, like)
        self._bounds = task.bounds.to(like.device)
        system = task.system
        self._angles = [name in system.angles for name in system.state_names]
        self._plain = type(system).observe is System.observe

    def locate(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""
        return self.task.locate(observation)

    def observe(self, state: Tensor) -> Tensor:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``."""
        return self.task.observe(state) if self.task.register_count else self._observe(state)

    def observe_first(self, state: Tensor, count: int) -> Tensor:
        """The observations ``[count, o]`` of the first rows of states ``[rows, n]``."""
        if self.task.register_count:
            return self.task.observe(state[:count])
        return self._observe(state)[:count]

    def transition(self, state: Tensor, action: Tensor) -> Transition:
        """One step: next state ``[rows, n]``, reward and (bool) terminated, each ``[rows]``."""
        command, next_state = self.advance(state, action)
        return Transition(next_state, *self.task.judge(state, command, next_state))

    def commands(self, actions: Tensor) -> Tensor | None:
        """The commands of actions ``[*batch, m]``; ``None`` where they depend on earlier ones."""
        if self.task.register_count:
            return None
        return actions.clamp(self._bounds.low, self._bounds.high)

    def advance(
        self, state: Tensor, action: Tensor, command: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the command ``[rows, m]`` of a step, and the next state ``[rows, n]``.

        Args:
            state: states ``[rows, n]``.
            action: actions ``[rows, m]``.
            command: their commands, if they are known.
        """
        if self.task.register_count:
            return self.task.move(self._step, state, action)
        command = self.commands(action) if command is None else command
        assert command is not None
        return command, self._step(state, command)

    def judge(
        self, state: Tensor, command: Tensor, next_state: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Reward and (bool) end of steps, each ``[*batch]``; ``None`` where nothing can end."""
        reward, ended = self.task.judge(state, command, next_state)
        return reward, ended if self.task.may_end else None

    def _observe(self, state: Tensor) -> Tensor:
        """The system's observation of a state; that of the last one is remembered."""
        if self._seen is None or self._seen[0] is not state:
            self._seen = (state, self._observed(state))
        return self._seen[1]

    def _observed(self, state: Tensor) -> Tensor:
        if not self._plain:
            return self.task.system.observe(state)
        columns: list[Tensor] = []
        for is_angle, each in zip(self._angles, state.unbind(-1), strict=True):
            columns += [each.cos(), each.sin()] if is_angle else [each]
        return torch.stack(columns, -1)

    def _make_step(self, dynamics: nn.Module, like: Tensor) -> Derivative:
        if not isinstance(dynamics, HybridDynamics):
            return dynamics
        if type(dynamics).step is not HybridDynamics.step:
            return dynamics.step
        derivative = self._make_derivative(dynamics)
        solve = dynamics.integrator.prepared(self.task.time_step, dynamics.layout, like)
        return lambda state, action: solve(lambda s: derivative(s, action), state)

    def _make_derivative(self, dynamics: HybridDynamics) -> Derivative:
        prior, residual = dynamics.prior, dynamics.residual
        if type(dynamics).derivative is not HybridDynamics.derivative:
            return dynamics.derivative
        if type(prior) is PhysicsPrior:
            prior = _with_constants(prior)
        corrected = residual.prepared() if type(residual) is ResidualMLP else None
        if corrected is not None:

            def residual(state: Tensor, action: Tensor) -> Tensor:
                return corrected(self._observe(state), action)

        if prior is None or residual is None:
            return prior or residual  # type: ignore[return-value]  # one of them is there
        return lambda state, action: prior(state, action) + residual(state, action)


def _with_constants(prior: PhysicsPrior) -> Derivative:
    """The prior with the constants that it has now, and their combinations, computed once."""
    constants = prior.constants()
    system = copy.copy(prior.system)
    combined = system.identifiable(constants)
    system.identifiable = lambda _: combined  # type: ignore[method-assign]
    return lambda state, action: system.prior(state, action, constants)
