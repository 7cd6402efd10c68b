"""What a caller gives to a controller beside the observation: known keys, and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from phihp_torchrl.deployment.under_way import COMPLETE
from phihp_torchrl.tasks import Signal, Task


class Entries:
    """Reads what is given by key: signals of the task, and what else the agent reads.

    Args:
        agent: the agent. What it and its actor read is in their ``in_keys``.
        task: the task of the controller, which may be another one than the agent's.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> Entries(Agent(task, actor=Actor(task)), task).read({"reference": [0.5]})
        Traceback (most recent call last):
        ...
        ValueError: reference: the agent and its task read no such entry, expected none.
    """

    def __init__(self, agent: TensorDictModuleBase, task: Task) -> None:
        tasks = (getattr(agent, "task", None), task)
        readers = (agent, getattr(agent, "actor", None))
        self._expected = {
            key: "numbers"
            for reader in readers
            for key in getattr(reader, "in_keys", ())
            if isinstance(key, str) and key not in ("observation", "is_init", COMPLETE)
        }
        for each in tasks:
            if isinstance(each, Task):
                self._expected |= {k: _expected(s) for k, s in each.outside.signals.items()}

    def read(self, given: Mapping[str, Any]) -> dict[str, Tensor]:
        """The entries that are finite, float32.

        Raises:
            ValueError: for a key that nobody reads, and for a value that is no number.
        """
        for key in given:
            if key not in self._expected:
                expected = f"some of {sorted(self._expected)}" if self._expected else "none"
                raise ValueError(
                    f"{key}: the agent and its task read no such entry, expected {expected}."
                )
        found = {key: as_numbers(key, v, self._expected[key]) for key, v in given.items()}
        return {key: value for key, value in found.items() if value.isfinite().all()}


def _expected(signal: Signal) -> str:
    preview = f" or {[signal.rows, signal.size]}" if signal.preview else ""
    return f"{signal.names} of shape {[signal.size]}{preview}"


def as_numbers(key: str, value: Any, expected: str = "numbers") -> Tensor:
    """A value as a float32 tensor; what float32 cannot hold is infinite in it.

    Arrays may be views in any order, as a reversed one, and of any byte order.

    Raises:
        ValueError: for what is no number and no array of real numbers; the message names the key.

    Examples:
        >>> as_numbers("speed", [1, 2])
        tensor([1., 2.])
    """
    try:
        if isinstance(value, (np.ndarray, np.generic)):
            value = torch.from_numpy(_native(value))
        if isinstance(value, Tensor) and value.is_complex():
            raise TypeError("expected real numbers")
        return torch.as_tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ValueError(f"{key}: expected {expected}, got {value!r}.") from error


def _native(value: Any) -> NDArray[Any]:
    """A copy of an array that torch can read, which knows no negative strides or foreign bytes."""
    array = np.array(value)
    return array.astype(array.dtype.newbyteorder("="), copy=False)
