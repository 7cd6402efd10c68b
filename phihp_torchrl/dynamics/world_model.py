"""A task and its dynamics as a TorchRL world model, whose latent state is the physical state."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import WorldModel

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.prepared import PreparedModel
from phihp_torchrl.tasks import Step, Task, Transition


class TaskWorldModel(WorldModel):
    """A task's model as a TorchRL world model: observation and action to next observation, reward.

    The encoder and the decoder are the system's observation map, and the heads are functions of the
    task, so that only the dynamics are learned. Besides the TensorDict interface of
    :class:`torchrl.modules.WorldModel` it has pure functions of tensors, which planners and
    imagination compile: :meth:`locate`, :meth:`observe` and :meth:`transition`.

    Args:
        task: the task.
        dynamics: a module ``(state, action) -> next state``, usually
            :class:`~phihp_torchrl.HybridDynamics`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> td = TensorDict(observation=torch.tensor([[1.0, 0.0, 0.0]]), action=torch.zeros(1, 1))
        >>> model(td)["next", "reward"].shape
        torch.Size([1, 1])
    """

    def __init__(self, task: Task, dynamics: nn.Module) -> None:
        reward, terminated = ("next", "reward"), ("next", "terminated")
        step = TensorDictModule(
            _Step(task, dynamics), ["state", "action"], [("next", "state"), reward, terminated]
        )
        super().__init__(
            encoder=TensorDictModule(task.locate, ["observation"], ["state"]),
            # A step of the task gives all results at once, so TorchRL's heads only pass them on.
            dynamics=step,
            reward_head=TensorDictModule(nn.Identity(), [reward], [reward]),
            done_head=TensorDictModule(nn.Identity(), [terminated], [terminated]),
            decoder=TensorDictModule(task.observe, [("next", "state")], [("next", "observation")]),
        )
        self.task = task

    def decode(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the observation of ``("next", "state")`` under ``"next"``, or else of ``"state"``.

        Raises:
            ConfigError: for a tensordict with neither.
        """
        if tensordict.get(("next", "state"), None) is not None:
            return super().decode(tensordict)
        state = tensordict.get("state", None)
        if state is None:
            keys = [str(key) for key in tensordict.keys(True, True)]
            raise ConfigError("state", f"expected 'state' or ('next', 'state'), got {keys}.")
        return tensordict.set("observation", self.observe(state))

    @property
    def transitions(self) -> nn.Module:
        """The dynamics, a module ``(state, action) -> next state``."""
        return self.dynamics.module.dynamics

    @property
    def compiles(self) -> bool:
        """Whether :meth:`transition` compiles as one graph; not with an adaptive integrator."""
        integrator = getattr(self.transitions, "integrator", None)
        return integrator is None or integrator.compiles

    def prepared(self) -> PreparedModel | TaskWorldModel:
        """The same functions for one eager plan or rollout, which later changes of weights miss.

        It is this model itself where a subclass, of the model or of the task, steps differently.
        """
        if not self.steps_as(TaskWorldModel):
            return self
        return PreparedModel(self.task, self.transitions, self.like)

    def steps_as(self, kind: type[TaskWorldModel]) -> bool:
        """Whether no subclass, of ``kind`` or of the task, has other functions of tensors."""
        ours: dict[tuple[type, type], tuple[str, ...]] = {
            (type(self), kind): ("locate", "observe", "transition"),
            (type(self.task), Task): ("transition", "is_terminated"),
        }
        return all(
            getattr(sub, name) is getattr(base, name)
            for (sub, base), names in ours.items()
            for name in names
        )

    @property
    def like(self) -> Tensor:
        """A tensor of the dtype and on the device of the dynamics."""
        return next(self.transitions.parameters(), torch.empty(0)).detach()

    def locate(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""
        return self.task.locate(observation)

    def observe(self, state: Tensor) -> Tensor:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``."""
        return self.task.observe(state)

    def transition(self, state: Tensor, action: Tensor) -> Transition:
        """One step: next state ``[*batch, n]``, reward and (bool) terminated, each ``[*batch]``."""
        return self.task.transition(_step_of(self.transitions), state, action)


class _Step(nn.Module):
    """A step for TensorDicts, with reward and termination of shape ``[*batch, 1]``."""

    def __init__(self, task: Task, dynamics: nn.Module) -> None:
        super().__init__()
        self.task, self.dynamics = task, dynamics

    def forward(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        next_state, reward, terminated = self.task.transition(
            _step_of(self.dynamics), state, action
        )
        return next_state, reward.unsqueeze(-1), terminated.unsqueeze(-1)


def _step_of(dynamics: nn.Module) -> Step:
    # HybridDynamics.forward clips the action, which the task has clipped already.
    return dynamics.step if isinstance(dynamics, HybridDynamics) else dynamics
