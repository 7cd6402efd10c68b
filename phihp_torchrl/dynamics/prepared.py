"""A world model for one plan or rollout: what no step changes is computed once."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.dynamics.compiled_step import count_operations
from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.prior import PhysicsPrior
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task, Transition

Derivative = Callable[[Tensor, Tensor], Tensor]


class PreparedModel:
    """The functions of a :class:`TaskWorldModel` in fewer and larger operations, up to rounding.

    It is made anew for each plan or rollout, because it reads the weights as they are then. States
    are matrices ``[rows, n]``, and nothing is differentiated. Beside the functions of a world model
    it has a step in two halves: :meth:`advance` moves the state, and :meth:`judge` gives rewards
    and ends of many steps at once.

    Without gradients and graphs, the time of a plan of some hundred rows is that of calling
    operations, not of their arithmetic. So the constants of the equations are computed once, and
    scales and places of components are part of the residual's layers.

    Args:
        task: the task.
        dynamics: a module ``(state, action) -> next state``.
        like: a tensor of the dtype and on the device of the states.

    Examples:
        >>> import torch
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
        self._step = self._make_step(dynamics, like)
        self._low, self._high = like.new_tensor(task.action_low), like.new_tensor(task.action_high)
        self._columns = self._columns_of_observation(like)

    @property
    def operations(self) -> int:
        """Number of tensor operations of a step of the dynamics."""
        sizes = self.task.system.state_dim, self.task.system.acting_dim
        return count_operations(self._step, *(self._low.new_zeros(2, size) for size in sizes))

    def locate(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""
        return self.task.locate(observation)

    def observe(self, state: Tensor) -> Tensor:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``."""
        if self._columns is None:
            return self.task.observe(state)
        # Fewer operations than to take the angles apart from the other components.
        features = torch.cat([state.cos(), state.sin(), state], -1)
        return features.index_select(-1, self._columns)

    def _columns_of_observation(self, like: Tensor) -> Tensor | None:
        """Where the observation is among cosines, sines and values; ``None`` for another one."""
        task, system = self.task, self.task.system
        known = type(task).observe is Task.observe and type(system).observe is System.observe
        if task.register_count or not known:
            return None
        return torch.tensor(system.feature_columns(), device=like.device)

    def transition(self, state: Tensor, action: Tensor) -> Transition:
        """One step: next state ``[rows, n]``, reward and (bool) terminated, each ``[rows]``."""
        command, next_state = self.advance(state, action)
        return Transition(next_state, *self.task.judge(state, command, next_state))

    def commands(self, actions: Tensor) -> Tensor | None:
        """The commands of actions ``[*batch, m]``; ``None`` where they depend on earlier ones."""
        if self.task.register_count:
            return None
        return actions.clamp(self._low, self._high)

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

    def judge_path(self, path: Tensor, commands: Tensor) -> tuple[Tensor, Tensor | None]:
        """Judge all steps of paths together.

        Args:
            path: states before each step, and after the last, ``[H + 1, rows, n]``.
            commands: the commands of the steps, ``[H * rows, m]``.

        Returns:
            Rewards ``[H, rows]``, and whether a path has ended by then, bool ``[H, rows]``;
            ``None`` where nothing can end.
        """
        shape = len(path) - 1, path.shape[1]
        before, after = path[:-1].flatten(0, 1), path[1:].flatten(0, 1)
        reward, ended = self.judge(before, commands, after)
        gone = None if ended is None else ended.view(shape).cumsum(0) > 0
        return reward.view(shape), gone

    def _make_step(self, dynamics: nn.Module, like: Tensor) -> Derivative:
        if not isinstance(dynamics, HybridDynamics):
            return dynamics
        if type(dynamics).step is not HybridDynamics.step:
            return dynamics.step
        if dynamics.compiled_step is not None:
            return dynamics.compiled_step
        derivative = self._make_derivative(dynamics)
        solve = dynamics.integrator.prepared(self.task.time_step, dynamics.layout, like)
        return lambda state, action: solve(lambda s: derivative(s, action), state)

    def _make_derivative(self, dynamics: HybridDynamics) -> Derivative:
        prior: Any = dynamics.prior
        residual: Any = dynamics.residual
        if type(dynamics).derivative is not HybridDynamics.derivative:
            return dynamics.derivative
        if type(prior) is PhysicsPrior:
            prior = _with_constants(prior)
        if type(residual) is ResidualMLP:
            residual = residual.prepared() or residual
        if prior is None or residual is None:
            return prior or residual  # one of them is there
        return lambda state, action: prior(state, action) + residual(state, action)


def _with_constants(prior: PhysicsPrior) -> Derivative:
    """The prior with the constants that it has now, and their combinations, computed once."""
    constants = prior.constants()
    system: Any = copy.copy(prior.system)
    combined = system.identifiable(constants)
    system.identifiable = lambda _: combined
    return lambda state, action: system.prior(state, action, constants)
