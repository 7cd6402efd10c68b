"""A limit of a state, or of a function of state and action, that a task asks to keep."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, plain_fields
from phihp_torchrl.tasks.outside import named

ConstrainedFn = Callable[..., Tensor]
"""``state [*batch, n] -> value [*batch]``; with a parameter ``action`` it gets ``[*batch, m]``."""


@dataclass(frozen=True)
class Constraint:
    """A limit that a task asks to keep, softly at a price, or hard as the end of the episode.

    It is judged after each step: by the physical state that the step led to, and the command of the
    step. The *violation* is how far the value is beyond the nearer limit, in physical units.

    A soft one takes ``price * violation`` from the reward where the task is imagined, and never in
    a world. A hard one ends the episode, in imagination and in worlds alike.

    Args:
        name: name of the state that is limited; with a ``function``, a name of your own.
        low: the lowest value that keeps it; ``None`` for no such limit.
        high: the highest value that keeps it; ``None`` for no such limit.
        price: of a soft one, reward for each unit of its violation in a step; 0 only reports it. Of
            a hard one, reward that its end costs, once, and in imagination alone; ``None`` is 0.
        hard: whether a violation ends the episode.
        function: what is limited instead of a state, ``state [*batch, n] -> [*batch]``, of the
            physical state alone; with a parameter ``action``, the command ``[*batch, m]`` too.

    Raises:
        ConfigError: for limits that are missing or not in order, and for a soft constraint without
            a price.

    Examples:
        >>> near = Constraint("x", low=-1.0, high=1.0, price=5.0)
        >>> near.violation(torch.tensor([0.5, 1.25, -3.0]))
        tensor([0.0000, 0.2500, 2.0000])
        >>> Constraint("x", high=1.0)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: constraints.x.price: expected a price, or hard=True.
    """

    name: str
    low: float | None = None
    high: float | None = None
    price: float | None = None
    hard: bool = False
    function: ConstrainedFn | None = field(default=None)

    def __post_init__(self) -> None:
        plain_fields(self)
        if not isinstance(self.name, str) or not self.name:
            raise ConfigError("constraints.name", f"expected a name, got {self.name!r}.")
        for key in ("low", "high", "price"):
            value = getattr(self, key)
            known = isinstance(value, (int, float)) and not isinstance(value, bool)
            if value is not None and not (known and math.isfinite(value)):
                raise self._error(key, f"expected a finite number, got {value!r}.")
        if self.low is None and self.high is None:
            raise self._error("low", "expected a lowest value, a highest value, or both.")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise self._error("low", f"expected less than high, {self.high}, got {self.low}.")
        if not isinstance(self.hard, bool):
            raise self._error("hard", f"expected true or false, got {self.hard!r}.")
        if self.price is None and not self.hard:
            raise self._error("price", "expected a price, or hard=True.")
        if self.price is not None and self.price < 0:
            raise self._error("price", f"expected a number >= 0, got {self.price}.")
        if self.function is not None and not callable(self.function):
            raise self._error("function", f"expected a function, got {self.function!r}.")

    def _error(self, key: str, reason: str) -> ConfigError:
        return ConfigError(f"constraints.{self.name}.{key}", reason)

    @property
    def reads_action(self) -> bool:
        """Whether its function has a parameter ``action``."""
        return bool(named(self.function, ["action"]))

    @property
    def config(self) -> dict[str, Any]:
        """Its plain values; of a function, only that there is one."""
        values = {"low": self.low, "high": self.high, "price": self.price, "hard": self.hard}
        return {"name": self.name, **values, **({"function": True} if self.function else {})}

    def violation(self, value: Tensor) -> Tensor:
        """How far values ``[*batch]`` are beyond a limit, in their units; 0 within them."""
        found = torch.zeros_like(value)
        if self.low is not None:
            found = (self.low - value).clamp_min(0.0)
        if self.high is not None:
            found = found + (value - self.high).clamp_min(0.0)
        return found
