"""A task and its dynamics as a TorchRL world model whose latent is the physical state."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import WorldModel

from phihp_torchrl.tasks import Task


class TaskWorldModel(WorldModel):
    """Observation -> state -> next state, reward, termination -> observation, in TorchRL's form.

    The encoder and decoder are the system's observation map, the heads are the task's functions, so
    the dynamics are all that is learned. Besides the TensorDict interface of
    :class:`torchrl.modules.WorldModel` it offers the same as pure functions of tensors, which
    planners and imagination compile: :meth:`locate`, :meth:`observe`, :meth:`transition`.

    Args:
        task: the task.
        dynamics: a module ``(state, action) -> next state``, usually
            :class:`~phihp_torchrl.HybridDynamics`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.oracle(task))
        >>> td = TensorDict(observation=torch.tensor([[1.0, 0.0, 0.0]]), action=torch.zeros(1, 1))
        >>> model(td)["next", "reward"].shape
        torch.Size([1, 1])
    """

    def __init__(self, task: Task, dynamics: nn.Module) -> None:
        next_state = ("next", "state")
        super().__init__(
            encoder=TensorDictModule(task.system.locate, ["observation"], ["state"]),
            dynamics=TensorDictModule(dynamics, ["state", "action"], [next_state]),
            reward_head=TensorDictModule(
                lambda state, action, next_state: task.reward(
                    state, task.clip_action(action), next_state
                ).unsqueeze(-1),
                ["state", "action", next_state],
                [("next", "reward")],
            ),
            done_head=TensorDictModule(
                lambda state: task.is_terminated(state).unsqueeze(-1),
                [next_state],
                [("next", "terminated")],
            ),
            decoder=TensorDictModule(task.system.observe, [next_state], [("next", "observation")]),
        )
        self.task = task

    @property
    def compiles(self) -> bool:
        """Whether :meth:`transition` compiles as one graph, as all but adaptive integrators do."""
        integrator = getattr(self.dynamics.module, "integrator", None)
        return integrator is None or integrator.compiles

    def locate(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""
        return self.task.system.locate(observation)

    def observe(self, state: Tensor) -> Tensor:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``."""
        return self.task.system.observe(state)

    def transition(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step: next state ``[*batch, n]``, reward and (bool) terminated, each ``[*batch]``."""
        action = self.task.clip_action(action)
        next_state = self.dynamics.module(state, action)
        reward = self.task.reward(state, action, next_state)
        return next_state, reward, self.task.is_terminated(next_state)
