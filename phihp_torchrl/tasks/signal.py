"""Signals from outside: references to follow, and inputs that are measured but not commanded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, is_whole, plain_fields
from phihp_torchrl.tasks.trajectories import Sampler, Trajectories


@dataclass(frozen=True)
class Signal:
    """Values from outside that change over time: a reference, or a measured input.

    A task keeps the present value, and the next ``preview`` values where they are known, in
    registers behind the physical state, one row of ``k`` numbers a step. At each step the rows move
    up. What comes after the last known value is unknown to a model and a planner, which take it to
    stay as it is.

    Args:
        names: the name of each component.
        low: the smallest value of each component, in physical units.
        high: the largest value of each component.
        preview: how many future values are known.
        sampler: draws trajectories for imagination and for simulated worlds: a
            :class:`Trajectories` within ``low`` and ``high``, or a function
            ``(shape, steps, time_step, generator) -> [*shape, steps, k]``.

    Raises:
        ConfigError: for fields that do not fit together; the message names the field.

    Examples:
        >>> position = Signal(("x",), low=(-1.0,), high=(1.0,), preview=2)
        >>> registers = position.read(torch.tensor([[0.1], [0.2], [0.3]]), "reference", [])
        >>> position.value(registers), position.shift(registers)
        (tensor([0.1000]), tensor([0.2000, 0.3000, 0.3000]))
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    preview: int = 0
    sampler: Sampler | Trajectories = field(default_factory=Trajectories)

    def __post_init__(self) -> None:
        plain_fields(self)
        object.__setattr__(self, "names", tuple(self.names))
        if not self.names or len(set(self.names)) < len(self.names):
            raise ConfigError("names", f"expected different names, got {self.names}.")
        for name in ("low", "high"):
            given = getattr(self, name)
            if not isinstance(given, (tuple, list)) or len(given) != len(self.names):
                raise ConfigError(
                    name, f"expected {len(self.names)} values for {self.names}, got {given!r}."
                )
            object.__setattr__(self, name, tuple(map(float, given)))
        pairs = list(zip(self.low, self.high, strict=True))
        if not all(-math.inf < low < high < math.inf for low, high in pairs):
            raise ConfigError(
                "low", f"expected finite values below high={self.high}, got {self.low}."
            )
        if not is_whole(self.preview, 0):
            raise ConfigError(
                "preview", f"expected a whole number of steps >= 0, got {self.preview!r}."
            )
        if not callable(self.sampler):
            raise ConfigError(
                "sampler", f"expected Trajectories or a function, got {self.sampler!r}."
            )

    @property
    def size(self) -> int:
        """Number of components, ``k``."""
        return len(self.names)

    @property
    def rows(self) -> int:
        """Number of values that are known at a time: the present one and those of the preview."""
        return self.preview + 1

    @property
    def registers(self) -> int:
        """Number of registers, ``rows * k``."""
        return self.rows * self.size

    @property
    def config(self) -> dict[str, Any]:
        """What an agent depends on, as plain values; how trajectories are drawn is left out."""
        kept = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "sampler"}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in kept.items()}

    def scales(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Middle and half-range of each register, ``[rows * k]``."""
        low, high = (like.new_tensor(end) for end in (self.low, self.high))
        return ((low + high) / 2).repeat(self.rows), ((high - low) / 2).repeat(self.rows)

    def value(self, registers: Tensor) -> Tensor:
        """The present value ``[*batch, k]``."""
        return registers[..., : self.size]

    def shift(self, registers: Tensor, incoming: Tensor | None = None) -> Tensor:
        """The registers one step later, ``[*batch, rows * k]``.

        Args:
            registers: the registers before, ``[*batch, rows * k]``.
            incoming: the value that becomes known, ``[*batch, k]``. Defaults to the last known one.
        """
        last = registers[..., -self.size :] if incoming is None else incoming
        return torch.cat([registers[..., self.size :], last], -1)

    def receive(self, registers: Tensor, incoming: Tensor) -> Tensor:
        """The registers with ``incoming`` ``[*batch, k]`` as the last value that is known."""
        return torch.cat([registers[..., : -self.size], incoming.to(registers)], -1)

    def window(self, trajectory: Tensor, step: int) -> Tensor:
        """The registers ``[*batch, rows * k]`` at a step of a trajectory ``[*batch, T, k]``.

        Beyond its end a trajectory stays at its last value.
        """
        rows = [min(step + row, trajectory.shape[-2] - 1) for row in range(self.rows)]
        return trajectory[..., rows, :].flatten(-2)

    def read(self, given: Tensor, key: str, batch: Sequence[int]) -> Tensor:
        """The registers ``[*batch, rows * k]`` from values that a caller gives.

        Args:
            given: the present value ``[*batch, k]``, which is taken to stay, or all values that are
                known, ``[*batch, rows, k]``.
            key: the key, for the message of an error.
            batch: the batch size.

        Raises:
            ValueError: for another shape, and on the CPU for values that are not finite.
        """
        batch, given = list(batch), torch.as_tensor(given)
        shapes = [[*batch, self.size], [*batch, self.rows, self.size]]
        if list(given.shape) not in shapes:
            raise ValueError(
                f"{key}: expected {self.names} of shape {shapes[0]}"
                + (f", or with its preview {shapes[1]}" if self.preview else "")
                + f", got shape {list(given.shape)}."
            )
        if given.device.type == "cpu" and not given.isfinite().all():
            raise ValueError(f"{key}: expected finite values, got some that are not.")
        if list(given.shape) == shapes[0]:
            return given.repeat(*[1] * len(batch), self.rows)
        return given.flatten(-2)

    def draw(
        self,
        shape: Sequence[int],
        steps: int,
        time_step: float,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw trajectories ``[*shape, steps, k]``, on the device of the generator.

        Raises:
            ValueError: for a sampler that gives another shape.
        """
        if isinstance(self.sampler, Trajectories):
            return self.sampler(shape, steps, time_step, generator, low=self.low, high=self.high)
        drawn = self.sampler(shape, steps, time_step, generator)
        if list(drawn.shape) != [*shape, steps, self.size]:
            raise ValueError(
                f"sampler: expected shape {[*shape, steps, self.size]}, got {list(drawn.shape)}."
            )
        return drawn.float()
