"""Simulated worlds, whose equations are known and which can be stepped in any batch shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import gymnasium
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.envs import Compose, EnvBase, GymWrapper, RewardSum, StepCounter, TransformedEnv

from phihp_torchrl.config import ConfigError, check_fields
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.imagination import WorldModelEnv
from phihp_torchrl.integrators import check_integrator, integrator_of
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.worlds.base import World
from phihp_torchrl.worlds.command_memory import command_memory
from phihp_torchrl.worlds.open_limits import open_limits
from phihp_torchrl.worlds.simulated.plant import Plant, PlantPhysics, find_plant


@dataclass(frozen=True)
class SimulatedConfig:
    """Settings of a :class:`SimulatedWorld`.

    Args:
        integrator: integrator of the world, semi_implicit_euler, rk4 or dopri5.
        substeps: solver steps in a control step; 1 for dopri5, which chooses its steps.
        constants: true constants that differ from the system's first guesses, by name.
        friction: friction coefficients that differ from the plant's defaults, by name.
        actuator: numbers in which the actuator of the world differs from the task's, by name.
        noise: standard deviation of what the sensors show, by name of the state.

    Raises:
        ConfigError: for an unknown integrator or a number of substeps that is not positive.

    Examples:
        >>> world = SimulatedWorld("cartpole", SimulatedConfig(friction={"cart": 0.0}))
        >>> world.truth.coefficients
        {'cart': 0.0, 'pole': 0.02}
    """

    kind: ClassVar[str] = "simulated"

    integrator: str = "semi_implicit_euler"
    substeps: int = 1
    constants: Mapping[str, float] = field(default_factory=dict, hash=False)
    friction: Mapping[str, float] = field(default_factory=dict, hash=False)
    actuator: Mapping[str, Any] = field(default_factory=dict, hash=False)
    noise: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        check_fields(self)
        check_integrator(self)
        for name, value in self.noise.items():
            if value < 0:
                raise ConfigError(f"noise.{name}", f"expected a number >= 0, got {value!r}.")


class SimulatedWorld(World):
    """A world simulated by the plant of the task's system: F^p with true constants, and friction.

    Args:
        task: a task or the name of a registered one.
        config: integrator, constants and friction. Defaults to ``SimulatedConfig()``.

    Raises:
        ConfigError: for unknown constants or coefficients, or a system that cannot be simulated.

    Examples:
        >>> world = SimulatedWorld("cartpole")
        >>> env = world.make_batch([8], seed=0)
        >>> env.rollout(20, break_when_any_done=False)["next", "episode_reward"].shape
        torch.Size([8, 20, 1])
        >>> world.truth.constants["cart_mass"]
        1.0
    """

    kind = SimulatedConfig.kind
    copies = True

    def __init__(self, task: str | Task, config: SimulatedConfig | None = None) -> None:
        super().__init__(find_task(task))
        self.config = config = config or SimulatedConfig()
        try:
            self._plant = find_plant(self.task.system, config.constants, config.friction)
        except ConfigError as error:
            key = error.key.replace("coefficients", "friction", 1)  # as the settings call them
            raise ConfigError(f"world.{key}", error.reason) from error
        self.actuator = self.task.with_actuator(config.actuator).actuator
        self.integrator = integrator_of(config)

    @property
    def truth(self) -> Plant:
        """The plant, with the true constants and friction."""
        return self._plant

    def oracle(self) -> HybridDynamics:
        """Return the world as dynamics without parameters, with friction and integrator."""
        physics = PlantPhysics(self._plant)
        return HybridDynamics(self.task, prior=physics, residual=None, integrator=self.integrator)

    def model(self) -> TaskWorldModel | None:
        """Return the world as an exact model, of any batch shape.

        Its rewards are the world's, without the prices of the task. There is none where the world
        treats commands otherwise than the task says, or where its
        sensors are noisy.
        """
        exact = self.actuator == self.task.actuator and not any(self.config.noise.values())
        return TaskWorldModel(self.task.unpriced(), self.oracle()) if exact else None

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """The next state: ``[*batch, n], [*batch, m] -> [*batch, n]``; the action is clipped."""
        return self._dynamics(state, action)

    def make_env(self, *, render: bool = False) -> EnvBase:
        env = gymnasium.make(
            "phihp/Task-v0",
            task=self.task,
            plant=self._plant,
            integrator=self.integrator,
            actuator=self.actuator,
            noise=self.config.noise,
            render_mode="rgb_array" if render else None,
        )
        wrapped = GymWrapper(env)
        transforms = Compose(StepCounter(), *open_limits(wrapped), *command_memory(self.task))
        return TransformedEnv(wrapped, transforms)

    def picture(self, env: EnvBase) -> NDArray[Any] | None:
        return env.base_env._env.render()

    def place(self, env: EnvBase, state: NDArray[Any], action: NDArray[Any] | None = None) -> None:
        """Put an environment of this world into a state, to draw it.

        Args:
            env: an environment of :meth:`make_env`.
            state: the physical state, or a state of the task, ``[n]`` or more.
            action: the action that led there, ``[m]``; ``None`` at the start.
        """
        wrapped = env.base_env._env
        wrapped.reset(options={"state": state[: len(self.task.system.state_names)]})
        wrapped.unwrapped.last_action = action

    def make_batch(
        self,
        batch_size: Sequence[int],
        *,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> TransformedEnv:
        """Make one TorchRL environment that simulates many worlds at once.

        Episodes are truncated after ``task.max_steps``. The environment also writes
        ``"step_count"`` and ``"episode_reward"``.

        Args:
            batch_size: number of worlds, in any shape.
            seed: seed of the resets.
            device: device of the data. Defaults to the CPU.

        Returns:
            The environment, in float32.
        """
        task = replace(self.task.unpriced(), actuator=self.actuator)
        model = TaskWorldModel(task, self.oracle())
        env = WorldModelEnv(model, batch_size=batch_size, device=device, seed=seed)
        return TransformedEnv(env, Compose(StepCounter(max_steps=self.task.max_steps), RewardSum()))

    @cached_property
    def _dynamics(self) -> HybridDynamics:
        # An oracle that nobody else has, so that nobody moves it to another device.
        return self.oracle()
