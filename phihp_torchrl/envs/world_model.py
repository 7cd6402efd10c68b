"""Imagination: a task's world model as a TorchRL environment, of any batch size."""

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
from phihp_torchrl.envs.start_states import BoxStates, StartStates


class WorldModelEnv(StockWorldModelEnv):
    """Steps a :class:`~phihp_torchrl.dynamics.TaskWorldModel` as if it were the world.

    Besides ``"observation"`` a tensordict carries ``"state"``, the model's latent: it goes along
    through steps, resets and auto-resets, and where it is missing it is found from the observation.
    An episode ends only where the task ends it; append a :class:`~torchrl.envs.StepCounter` to
    truncate it. Gradients flow through a rollout unless the caller forbids them, as TorchRL's
    collectors do.

    With ``batch_size=()`` tensordicts of any batch shape are accepted, which planners need. With
    another one the env holds that many worlds, and is locked to them.

    ``reset(tensordict)`` starts from the ``"state"`` or else from the ``"observation"`` given,
    unless ``set_state=False`` or a ``"_reset"`` mask asks for fresh states. Wrapped in a
    :class:`~torchrl.envs.TransformedEnv`, ask with ``set_state=True``, as TorchRL prescribes.

    It mends :class:`torchrl.envs.model_based.WorldModelEnv` (specs of batches, latents lost at
    auto-resets, termination) for models of a known task. Other
    :class:`~torchrl.modules.WorldModel` instances know neither their specs nor where to start, and
    want a :class:`~torchrl.envs.ModelBasedEnvBase` of their own.

    Args:
        world_model: the task's model; later changes of its parameters are seen at once.
        start_states: where episodes start. Defaults to the task's resets.
        batch_size: number of worlds, in any shape.
        device: device of the model and of all data. Defaults to the model's own.
        seed: seed of the resets. Defaults to a draw from torch's global generator.

    Raises:
        TypeError: for a world model that is not a task's.
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
        # The base class leaves every env unlocked, but then drops rows from a batch of its own.
        self._batch_locked = len(self.batch_size) > 0
        self.start_states = (
            BoxStates(world_model.task.reset) if start_states is None else start_states
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
            system = task.system
            return Composite(
                observation=vector(system.observation_dim),
                state=vector(system.state_dim),
                shape=batch,
                device=device,
            )

        self.observation_spec = situation()
        self.state_spec = situation()  # what a step or a reset may start from
        high = torch.tensor(task.action_high, device=device).expand(*batch, -1)
        self.action_spec = Bounded(low=-high, high=high)
        self.reward_spec = vector(1)
        self.done_spec = Binary(shape=(*batch, 1), device=device, dtype=torch.bool)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = int(torch.empty((), dtype=torch.int64).random_())
        self.generator.manual_seed(seed)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch, system = tensordict.batch_size, self.tensor_model.task.system
        state = self._find_state(tensordict)
        action = self._checked("action", tensordict.get("action", None), batch, system.action_dim)
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
            self._checked("start_states", state, batch, self.tensor_model.task.system.state_dim)
        return self._result(state, torch.zeros_like(state[..., 0], dtype=torch.bool))

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        # Rows under a mask are over: what the tensordict says of them is from before.
        if tensordict is None or "_reset" in tensordict:
            return False
        return super()._input_td_has_state(tensordict)

    def _resolve_set_state(
        self, set_state: bool | None, tensordict: TensorDictBase | None, select_reset_only: bool
    ) -> bool | None:
        # A given start counts without a word, here as in the stock class and in later TorchRL too.
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
        batch, system = tensordict.batch_size, self.tensor_model.task.system
        state = tensordict.get("state", None)
        if state is not None:
            return self._checked("state", state, batch, system.state_dim)
        observation = tensordict.get("observation", None)
        return self.tensor_model.locate(
            self._checked("observation", observation, batch, system.observation_dim)
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
