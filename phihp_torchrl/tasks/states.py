"""The states and observations of a task: their sizes, and the maps between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from phihp_torchrl.systems import System
from phihp_torchrl.tasks.bounds import ActionBounds
from phihp_torchrl.tasks.box import Box
from phihp_torchrl.tasks.outside import Outside
from phihp_torchrl.tasks.registers import Registers


class States:
    """What a state of a task is: the system's components, and then the registers.

    A :class:`~phihp_torchrl.Task` is one of these; it has the fields that they read.
    """

    if TYPE_CHECKING:  # fields of the task

        @property
        def system(self) -> System: ...
        @property
        def action_low(self) -> tuple[float, ...] | None: ...
        @property
        def action_high(self) -> tuple[float, ...]: ...
        @property
        def reset(self) -> Box: ...
        @property
        def registers(self) -> Registers: ...
        @property
        def outside(self) -> Outside: ...

    # Sizes and maps of states, observations and actions, for everything that uses a task.

    @property
    def register_count(self) -> int:
        """Number of registers, ``r``: of all that the task adds to the physical state."""
        return self.registers.size

    @property
    def state_dim(self) -> int:
        """Number of state components, ``n``: those of the system, and then the registers."""
        return self.system.state_dim + self.register_count

    @property
    def action_dim(self) -> int:
        """Number of action components, ``m``."""
        return self.system.action_dim

    @property
    def observation_dim(self) -> int:
        """Number of observation components, ``o``: those of the system, and the registers."""
        return self.system.observation_dim + self.register_count

    @property
    def shown_dim(self) -> int:
        """Number of components that a world shows: the system's observation, and the signals."""
        return self.system.observation_dim + self.outside.size

    @property
    def bounds(self) -> ActionBounds:
        """Bounds of the action, float32 ``[m]``, on the CPU."""
        return ActionBounds.from_limits(self.action_low or (), self.action_high)

    def clip_action(self, action: Tensor) -> Tensor:
        """Clip an action ``[*batch, m]`` to its bounds."""
        limits = zip(action.unbind(-1), self.action_low or (), self.action_high, strict=True)
        return torch.stack([a.clamp(low, high) for a, low, high in limits], -1)

    def observe(self, state: Tensor) -> Tensor:
        """State ``[*batch, n]`` -> observation ``[*batch, o]``; registers in half-ranges."""
        if not self.register_count:
            return self.system.observe(state)
        physical, registers = self.split(state)
        return self.complete(self.system.observe(physical), registers)

    def locate(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> state ``[*batch, n]``."""
        if not self.register_count:
            return self.system.locate(observation)
        size = self.system.observation_dim
        center, scale = self.registers.scales(observation)
        registers = center + scale * observation[..., size:]
        return torch.cat([self.system.locate(observation[..., :size]), registers], -1)

    def difference(self, state: Tensor, other: Tensor) -> Tensor:
        """``state - other``, with differences of angles in [-pi, pi); registers may be left out."""
        return self.system.difference(state, other)

    # The registers of a task that adds some; without them, states are physical as they are.

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Split a state ``[*batch, n]`` into its physical components and its registers."""
        size = self.system.state_dim
        physical = state[..., :size] if self.register_count else state
        return physical, state[..., size:]

    def at_rest(self, physical: Tensor) -> Tensor:
        """The state ``[*batch, n]`` of physical components with nothing under way."""
        if not self.register_count:
            return physical
        return torch.cat([physical, self.rest(physical)], -1)

    def sample_start(
        self, shape: torch.Size | list[int], generator: torch.Generator | None = None
    ) -> Tensor:
        """Draw states ``[*shape, n]`` in which episodes start, with nothing under way.

        References and inputs are drawn too.
        """
        return self.at_start(self.reset.sample(shape, generator=generator), generator)

    def at_start(self, physical: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The state ``[*batch, n]`` of physical components in which an episode starts."""
        if not self.register_count:
            return physical
        still = physical.new_zeros([*physical.shape[:-1], self.action_dim])
        registers = self.registers.start(self.clip_action(still), generator)
        return torch.cat([physical, registers], -1)

    def complete(self, observation: Tensor, registers: Tensor) -> Tensor:
        """The task's observation ``[*batch, o]`` from one of the system's and the registers.

        Args:
            observation: the system's observation, perhaps with the first registers behind it.
            registers: all registers, ``[*batch, r]``; those that are in the observation are not
                used.
        """
        center, scale = self.registers.scales(observation)
        known = observation.shape[-1] - self.system.observation_dim
        scaled = (registers.to(observation.dtype) - center) / scale
        return torch.cat([observation, scaled[..., known:]], -1)

    def with_signals(self, state: Tensor, signals: Tensor) -> Tensor:
        """The state ``[*batch, n]`` with other signals, registers ``[*batch, outside.size]``."""
        physical, registers = self.split(state)
        return torch.cat([physical, self.outside.replaced(registers, signals)], -1)

    def rest(self, like: Tensor) -> Tensor:
        """The registers ``[*batch, r]`` with nothing under way, for a tensor ``[*batch, ...]``."""
        still = torch.zeros_like(like[..., :1]).expand(*like.shape[:-1], self.action_dim)
        return self.registers.rest(self.clip_action(still))

    def random_registers(
        self, shape: Sequence[int], generator: torch.Generator | None = None
    ) -> Tensor:
        """Draw registers ``[*shape, r]`` as in the middle of an episode, on the generator's device.

        The commands before are uniform in their bounds.
        """
        device = torch.device("cpu") if generator is None else generator.device
        size = [*shape, max(self.registers.past, 1), self.action_dim]
        unit = torch.rand(size, generator=generator, device=device).mul(2).sub(1)
        return self.registers.random(self.bounds.to(device).from_unit(unit), generator)
