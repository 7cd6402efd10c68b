"""What comes to a task from outside, its reference and its inputs, as one piece of its state."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.tasks.signal import Signal
from phihp_torchrl.tasks.signal_parts import SignalPart

Trajectory = Mapping[str, Tensor]
"""Values over time of each signal by its key, ``[*batch, T, k]``."""


class Outside:
    """The signals of a task: the first registers of its state, and how they go on.

    A model and a planner move these registers by what they know: the rows move up, and the last one
    stays. Whoever knows more, as a world does, replaces the registers after each step by the window
    of a trajectory.

    Args:
        parts: the parts of the signals, the first parts of the task.

    Examples:
        >>> target = SignalPart("reference", Signal(("x",), (-1.0,), (1.0,)), 0.1, acts=False)
        >>> outside = Outside([target])
        >>> trajectory = {"reference": torch.tensor([[0.1], [0.2], [0.3]])}
        >>> outside.window(trajectory, 1), outside.values(outside.window(trajectory, 1))
        (tensor([0.2000]), {'reference': tensor([0.2000])})
    """

    def __init__(self, parts: Sequence[SignalPart]) -> None:
        self.parts = tuple(parts)
        self.sizes = [part.size for part in self.parts]
        self.size = sum(self.sizes)

    def __bool__(self) -> bool:
        return bool(self.parts)

    @property
    def signals(self) -> dict[str, Signal]:
        """The signals by their keys."""
        return {part.name: part.signal for part in self.parts}

    @property
    def config(self) -> dict[str, Any]:
        """What an agent depends on, by key."""
        return {name: signal.config for name, signal in self.signals.items()}

    def split(self, registers: Tensor) -> dict[str, Tensor]:
        """The registers of each signal, from the registers ``[*batch, r]`` of a task."""
        parts = registers[..., : self.size].split(self.sizes, -1) if self.parts else ()
        return dict(zip(self.signals, parts, strict=True))

    def values(self, registers: Tensor) -> dict[str, Tensor]:
        """The present value ``[*batch, k]`` of each signal, from the registers of a task."""
        parts = self.split(registers)
        return {name: signal.value(parts[name]) for name, signal in self.signals.items()}

    def replaced(self, registers: Tensor, own: Tensor) -> Tensor:
        """The registers ``[*batch, r]`` of a task with others, ``[*batch, size]``, of its own."""
        return torch.cat([own.to(registers), registers[..., self.size :]], -1)

    def draw(
        self, shape: Sequence[int], steps: int, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Draw trajectories that are known for ``steps`` steps, and for their previews after."""
        return {
            part.name: part.signal.draw(
                shape, steps + part.signal.preview, part.time_step, generator
            )
            for part in self.parts
        }

    def window(self, trajectory: Trajectory, step: int) -> Tensor:
        """The registers ``[*batch, size]`` at a step of a trajectory."""
        windows = [s.window(trajectory[name], step) for name, s in self.signals.items()]
        return torch.cat(windows, -1)

    def windows(self, trajectory: Trajectory, first: int, steps: int) -> Tensor:
        """The registers at steps from ``first`` on, ``[steps, *batch, size]``."""
        return torch.stack([self.window(trajectory, first + k) for k in range(steps)])

    def read(self, given: Mapping[str, Any], like: Tensor) -> Tensor:
        """The registers ``[*batch, size]`` from values that a caller gives under their keys.

        Args:
            given: values by key, as :meth:`Signal.read` accepts them.
            like: the registers ``[*batch, size]`` that stay where a key has no value.

        Returns:
            The registers, with dtype and device of ``like``.
        """
        own = self.split(like)
        for name, signal in self.signals.items():
            value = given.get(name, None)
            if value is not None:
                own[name] = signal.read(value, name, like.shape[:-1]).to(like)
        return torch.cat(list(own.values()), -1)


def named(function: Callable[..., Any] | None, keys: Iterable[str]) -> tuple[str, ...]:
    """The keys that are names of parameters of a function, which then gets these signals.

    Examples:
        >>> named(lambda state, action, next_state, reference: 0.0, ["reference", "inputs"])
        ('reference',)
    """
    if function is None:
        return ()
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):  # a function of C has none that can be read
        return ()
    return tuple(key for key in keys if key in parameters)
