"""A task's world model as a TorchRL environment of any batch size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.envs.model_based import WorldModelEnv as StockWorldModelEnv

from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination.start_states import BoxStates, StartStates, TaskStates


class WorldModelEnv(StockWorldModelEnv):
    """A TorchRL environment that steps a :class:`~phihp_torchrl.dynamics.TaskWorldModel`.

    Besides ``"observation"`` a tensordict has ``"state"``, the state of the model, which is kept in
    steps, resets and auto-resets. If it is missing, it is computed from the observation. An episode
    ends only where the task terminates it; append a :class:`~torchrl.envs.StepCounter` to truncate
    it. Gradients flow through a rollout unless the caller disables them, as TorchRL's collectors
    do.

    With ``batch_size=()`` it accepts tensordicts of any batch shape, which planners need. With
    another batch size it holds that many worlds and accepts only that shape.

    ``reset(tensordict)`` starts from the ``"state"`` or else from the ``"observation"`` given,
    unless ``set_state=False`` or a ``"_reset"`` mask asks for fresh states. Wrapped in a
    :class:`~torchrl.envs.TransformedEnv`, ask with ``set_state=True``, as TorchRL prescribes.

    For models of a known task it corrects :class:`torchrl.envs.model_based.WorldModelEnv`, whose
    specs lack the batch size, whose auto-resets lose the latent state, and which has no
    termination. Other :class:`~torchrl.modules.WorldModel` instances have neither specs nor start
    states; subclass :class:`~torchrl.envs.ModelBasedEnvBase` for them.

    Args:
        world_model: the task's model; later changes of its parameters take effect at once.
        start_states: start states of episodes. Defaults to the task's reset box.
        batch_size: number of worlds, in any shape.
        device: device of the model and of all data. Defaults to the device of the model.
        seed: seed of the resets. Defaults to a number from torch's global generator.

    Raises:
        TypeError: for a world model that is not a :class:`TaskWorldModel`.
        ValueError: from ``reset`` and ``step``, for an action, observation or state of the wrong
            shape, dtype or device, and for a start that is not finite; the message names the key.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> task = get_task("pendulum")
        >>> env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.hybrid(task)), batch_size=[64])
        >>> env.rollout(10)["observation"].shape
        torch.Size([64, 10, 3])
    """

    _supports_set_state = True

    def __init__(
        self,
        world_model: TaskWorldModel,
        *,
        start_states: StartStates | None = None,
        batch_size: Sequence[int] = (),
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        if not isinstance(world_model, TaskWorldModel):
            raise TypeError(
                f"world_model: expected a TaskWorldModel, got {type(world_model).__name__}; "
                "subclass torchrl.envs.model_based.ModelBasedEnvBase for other world models."
            )
        if device is None:
            tensors = [*world_model.parameters(), *world_model.buffers()]
            device = tensors[0].device if tensors else "cpu"
        # The stock __init__ copies the specs of a reference env; here the task knows them.
        ModelBasedEnvBase.__init__(
            self, world_model.step_module, device=device, batch_size=torch.Size(batch_size)
        )
        self._world_model = world_model.to(self.device)
        self.latent_key = "state"
        # The base class unlocks every env, which then drops rows of a batch that has a size.
        self._batch_locked = len(self.batch_size) > 0
        self.start_states = (
            TaskStates(world_model.task, BoxStates(world_model.task.reset), under_way=False)
            if start_states is None
            else start_states
        )
        self.generator = torch.Generator()  # on the CPU: a seed means the same on every device
        self._set_seed(seed)
        self._set_specs()

    @property
    def tensor_model(self) -> TaskWorldModel:
        """The model, with ``locate``, ``observe`` and ``transition`` as functions of tensors."""
        return self._world_model

    def _set_specs(self) -> None:
        task, batch, device = self.tensor_model.task, self.batch_size, self.device

        def vector(size: int) -> Unbounded:
            return Unbounded(shape=(*batch, size), device=device)

        def situation() -> Composite:
            return Composite(
                observation=vector(task.observation_dim),
                state=vector(task.state_dim),
                shape=batch,
                device=device,
            )

        self.observation_spec = situation()
        self.state_spec = situation()  # the keys from which a step or a reset may start
        low, high = (limit.to(device).expand(*batch, -1) for limit in task.bounds[:2])
        self.action_spec = Bounded(low=low, high=high)
        self.reward_spec = vector(1)
        self.done_spec = Binary(shape=(*batch, 1), device=device, dtype=torch.bool)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = int(torch.empty((), dtype=torch.int64).random_())
        self.generator.manual_seed(seed)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch, task = tensordict.batch_size, self.tensor_model.task
        state = self._find_state(tensordict)
        action = self._checked("action", tensordict.get("action", None), batch, task.action_dim)
        next_state, reward, terminated = self.tensor_model.transition(state, action)
        return self._result(next_state, terminated).set("reward", reward.unsqueeze(-1))

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any
    ) -> TensorDictBase:
        if set_state and tensordict is not None:
            state = self._find_state(tensordict)
            if not state.isfinite().all():
                raise ValueError("state: expected finite states to start from, got others.")
        else:
            batch = self.batch_size if tensordict is None else tensordict.batch_size
            state = self.start_states.sample(batch, self.generator, self.device)
            self._checked("start_states", state, batch, self.tensor_model.task.state_dim)
        return self._result(state, torch.zeros_like(state[..., 0], dtype=torch.bool))

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        # A mask selects rows whose episode has ended, so their state in the tensordict is old.
        if tensordict is None or "_reset" in tensordict:
            return False
        return super()._input_td_has_state(tensordict)

    def _resolve_set_state(
        self, set_state: bool | None, tensordict: TensorDictBase | None, select_reset_only: bool
    ) -> bool | None:
        # A state in the tensordict is used without set_state=True, as in the stock class.
        if set_state is None and not select_reset_only:
            set_state = self._input_td_has_state(tensordict)
        return super()._resolve_set_state(set_state, tensordict, select_reset_only)

    def _result(self, state: Tensor, terminated: Tensor) -> TensorDict:
        terminated = terminated.unsqueeze(-1)
        return TensorDict(
            {
                "observation": self.tensor_model.observe(state),
                "state": state,
                "terminated": terminated,
                "done": terminated.clone(),
            },
            batch_size=state.shape[:-1],
            device=self.device,
        )

    def _find_state(self, tensordict: TensorDictBase) -> Tensor:
        batch, task = tensordict.batch_size, self.tensor_model.task
        state = tensordict.get("state", None)
        if state is not None:
            return self._checked("state", state, batch, task.state_dim)
        observation = tensordict.get("observation", None)
        return self.tensor_model.locate(
            self._checked("observation", observation, batch, task.observation_dim)
        )

    def _checked(self, key: str, value: Tensor | None, batch: torch.Size, size: int) -> Tensor:
        shape = (*batch, size)
        if value is None:
            raise ValueError(f"{key}: expected a tensor of shape {list(shape)}, got none.")
        if (value.shape, value.dtype, value.device) != (shape, torch.float32, self.device):
            raise ValueError(
                f"{key}: expected torch.float32 of shape {list(shape)} on {self.device}, "
                f"got {value.dtype} of shape {list(value.shape)} on {value.device}."
            )
        return value
