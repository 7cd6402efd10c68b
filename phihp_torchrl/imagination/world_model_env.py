"""A task's world model as a TorchRL environment of any batch size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.envs.model_based import WorldModelEnv as StockWorldModelEnv
from torchrl.modules import WorldModel

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination.generator_state import pack_generator, unpack_generator
from phihp_torchrl.imagination.given_starts import GivenStarts
from phihp_torchrl.imagination.latent_model_env import LatentModelEnv
from phihp_torchrl.imagination.start_states import BoxStates, StartStates, TaskStates


class WorldModelEnv(GivenStarts, StockWorldModelEnv):
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
    termination. :meth:`from_world_model` makes an environment of any other
    :class:`~torchrl.modules.WorldModel`.

    Args:
        world_model: the task's model; later changes of its parameters take effect at once.
        start_states: start states of episodes. Defaults to the task's reset box.
        batch_size: number of worlds, in any shape.
        device: device of the model and of all data. Defaults to the device of the model.
        seed: seed of the resets. Defaults to a number from torch's global generator.

    Raises:
        TypeError: for a world model that is not a :class:`TaskWorldModel`.
        ConfigError: for a batch size with a 0 in it.
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

    computed_keys = ("state",)
    """Keys that a step computes from the observation where they are missing."""
    computed_from = ("observation",)
    """The keys that it computes them from."""

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
                "WorldModelEnv.from_world_model takes other world models."
            )
        if device is None:
            tensors = [*world_model.parameters(), *world_model.buffers()]
            device = tensors[0].device if tensors else "cpu"
        if 0 in (sizes := tuple(batch_size)):
            raise ConfigError("batch_size", f"expected sizes of one and more, got {list(sizes)}.")
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

    @classmethod
    def from_world_model(
        cls, world_model: WorldModel, base_env: EnvBase | None = None, **options: Any
    ) -> EnvBase:
        """Make an environment of any world model, for planners and rollouts.

        Args:
            world_model: a :class:`TaskWorldModel`, or another :class:`torchrl.modules.WorldModel`.
            base_env: an environment with the specs of action, reward and flags, and with the
                observations that the encoder reads; not needed for a :class:`TaskWorldModel`.
            options: further arguments of this class, or for other world models ``start`` and
                ``done`` of :class:`~phihp_torchrl.imagination.LatentModelEnv`.

        Returns:
            A ``WorldModelEnv``, or for other world models an environment that steps in latents.

        Raises:
            ConfigError: for another world model without a ``base_env`` that fits.
        """
        if isinstance(world_model, TaskWorldModel):
            return cls(world_model, **options)
        if base_env is None:
            raise ConfigError(
                "base_env",
                f"expected an environment with the specs of a {type(world_model).__name__}, "
                "got none.",
            )
        return LatentModelEnv(world_model, base_env, **options)

    @property
    def tensor_model(self) -> TaskWorldModel:
        """The model, with ``locate``, ``observe`` and ``transition`` as functions of tensors."""
        return self._world_model

    def _set_specs(self) -> None:
        task, batch, device = self.tensor_model.task, self.batch_size, self.device
        self._dtype = dtype = _dtype_of(self.tensor_model)

        def vector(size: int) -> Unbounded:
            return Unbounded(shape=(*batch, size), device=device, dtype=dtype)

        def situation() -> Composite:
            return Composite(
                observation=vector(task.observation_dim),
                state=vector(task.state_dim),
                shape=batch,
                device=device,
            )

        self.observation_spec = situation()
        self.state_spec = situation()  # the keys from which a step or a reset may start
        low, high = (limit.to(device, dtype).expand(*batch, -1) for limit in task.bounds[:2])
        self.action_spec = Bounded(low=low, high=high, dtype=dtype)
        self.reward_spec = vector(1)
        self.done_spec = Binary(shape=(*batch, 1), device=device, dtype=torch.bool)

    def _apply(self, *args: Any, **kwargs: Any) -> WorldModelEnv:
        super()._apply(*args, **kwargs)
        if self._dtype != _dtype_of(self.tensor_model):  # as after double()
            self._set_specs()
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "generator": pack_generator(self.generator)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "generator": unpack_generator(state["generator"])})

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
            state = self.start_states.sample(batch, self.generator, self.device).to(self._dtype)
            self._checked("start_states", state, batch, self.tensor_model.task.state_dim)
        return self._result(state, torch.zeros_like(state[..., 0], dtype=torch.bool))

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
        if (value.shape, value.dtype, value.device) != (shape, self._dtype, self.device):
            raise ValueError(
                f"{key}: expected {self._dtype} of shape {list(shape)} on {self.device}, "
                f"got {value.dtype} of shape {list(value.shape)} on {value.device}."
            )
        return value


def _dtype_of(model: TaskWorldModel) -> torch.dtype:
    """The dtype of a model's parameters, or float32 for a model without."""
    tensors = [*model.parameters(), *model.buffers()]
    return next((t.dtype for t in tensors if t.is_floating_point()), torch.float32)
