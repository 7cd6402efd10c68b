"""Recorded episodes: the samples of a log, in the units of a system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.systems import System


@dataclass(frozen=True)
class Recording:
    """The samples of one uninterrupted stretch of an episode.

    A gap in the samples ends a recording, and a later one with the same ``episode`` goes on after
    it, so that nothing is ever bridged. A sample whose command or input is missing cannot be used
    at all; a sample of which a state is missing is kept, with NaN in that component.

    Args:
        time: times of the samples in seconds, strictly increasing, float64 ``[T]``.
        state: measured states, in the order and in the units of the system, float64 ``[T, n]``;
            NaN where a component was not measured.
        action: commands in physical units, float64 ``[T, m]``; command ``i`` was given at time
            ``i`` and held until time ``i + 1``. The last one has no known duration.
        source: where the samples are from, for messages: a file, or an environment.
        episode: number of the episode.
        inputs: what acted besides and was measured, in the order of the system's ``input_names``
            and in physical units, float64 ``[T, k]``; each is taken to stay until the next sample.
            Defaults to none, ``[T, 0]``.

    Raises:
        ConfigError: for shapes that do not belong together, times that do not increase, commands
            or inputs that are not finite, or fewer than two samples.

    Examples:
        >>> time = torch.arange(3, dtype=torch.float64)
        >>> swing = Recording(time, torch.zeros(3, 2), torch.zeros(3, 1), source="swing.csv")
        >>> len(swing), swing.intervals.tolist()
        (3, [1.0, 1.0])
    """

    time: Tensor
    state: Tensor
    action: Tensor
    source: str = "recording"
    episode: int = 0
    inputs: Tensor = field(default_factory=lambda: torch.zeros(0, 0))

    def __post_init__(self) -> None:
        for name in ("time", "state", "action", "inputs"):
            object.__setattr__(self, name, torch.as_tensor(getattr(self, name)).double())
        length = len(self.time)
        if self.inputs.ndim == 2 and not self.inputs.shape[-1]:  # none, for any number of samples
            object.__setattr__(self, "inputs", self.inputs.new_zeros(length, 0))
        if length < 2:
            raise ConfigError("time", f"{self.source}: expected two samples or more, got {length}.")
        for name in ("state", "action", "inputs"):
            shape = list(getattr(self, name).shape)
            if len(shape) != 2 or shape[0] != length:
                raise ConfigError(
                    name, f"{self.source}: expected shape [{length}, ...], got {shape}."
                )
        late = (self.time.diff() <= 0).nonzero()
        if len(late):
            at = int(late[0])
            raise ConfigError(
                "time",
                f"{self.source}: expected increasing times, got {self.time[at]:g} and then "
                f"{self.time[at + 1]:g} at sample {at + 1}.",
            )
        for name, what in (("action", "commands"), ("inputs", "inputs")):
            if not getattr(self, name).isfinite().all():
                raise ConfigError(name, f"{self.source}: expected finite {what} in each sample.")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def intervals(self) -> Tensor:
        """Seconds between samples, ``[T - 1]``."""
        return self.time.diff()

    @property
    def measured(self) -> Tensor:
        """Which components of the state were ever measured, bool ``[n]``."""
        return self.state.isfinite().any(0)


def check_columns(system: System, recordings: Sequence[Recording], key: str = "recordings") -> None:
    """Refuse recordings that do not have the states, actions and inputs of a system.

    Raises:
        ConfigError: with ``key`` as its key; the message names the recording.
    """
    states, actions = system.state_names, system.action_names
    for log in recordings:
        found = log.state.shape[-1], log.action.shape[-1]
        if found != (len(states), len(actions)):
            raise ConfigError(
                key,
                f"{log.source}: expected states {states} and commands {actions}, got "
                f"{found[0]} and {found[1]} columns.",
            )
        measured = log.inputs.shape[-1]
        if measured != len(system.input_names):
            raise ConfigError(
                key,
                f"{log.source}: expected a column for each of the inputs {system.input_names} of "
                f"{type(system).__name__}, got {measured}.",
            )
