"""References and inputs of imagined worlds, which go on through all their lives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.tasks import Task

_LENGTH = 500
"""Steps for which trajectories are drawn at a time."""


class SignalStream:
    """The signals of many worlds, step by step and without end.

    A world's signals do not start anew with its lives: they go on, so that a life meets them in the
    middle of a ramp as well as at a step. Trajectories are drawn for 500 steps at a time.

    Args:
        task: the task.
        worlds: number of worlds.
        generator: source of randomness.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import Signal, get_task
        >>> task = get_task("pendulum")
        >>> aim = Signal(("theta",), low=(-1.0,), high=(1.0,), preview=3)
        >>> towards = lambda state, action, following, reference: -reference[..., 0].square()
        >>> stream = SignalStream(replace(task, reference=aim, reward=towards), worlds=8)
        >>> first = stream.present()
        >>> windows = stream.advance(10)  # of the ten steps that follow
        >>> windows.shape, bool((windows[0, :, :3] == first[:, 1:]).all())
        (torch.Size([10, 8, 4]), True)
    """

    def __init__(self, task: Task, worlds: int, generator: torch.Generator | None = None) -> None:
        self.task, self.worlds, self.generator = task, worlds, generator
        self._drawn = self._draw()
        self._step = 0

    def _draw(self) -> dict[str, Tensor]:
        return self.task.outside.draw([self.worlds], _LENGTH, self.generator)

    def present(self) -> Tensor:
        """The signals now, registers ``[worlds, size]``."""
        return self.task.outside.window(self._drawn, self._step)

    def advance(self, steps: int) -> Tensor:
        """Move on; returns the signals after each step, registers ``[steps, worlds, size]``."""
        windows = []
        for _ in range(steps):
            self._step += 1
            if self._step == _LENGTH:
                self._drawn, self._step = self._draw(), 0
            windows.append(self.present())
        return torch.stack(windows)

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs."""
        return {"drawn": dict(self._drawn), "step": self._step}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self._drawn, self._step = dict(state["drawn"]), int(state["step"])
