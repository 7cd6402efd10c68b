"""A world of recordings, in which nobody can act."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NoReturn

from phihp_torchrl.config import ConfigError, check_fields
from phihp_torchrl.recordings import (
    RecordedData,
    Recording,
    check_columns,
    estimate_velocities,
    read_recordings,
)
from phihp_torchrl.tasks import Task
from phihp_torchrl.worlds.base import World

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordedConfig:
    """Settings of a :class:`RecordedWorld`.

    Args:
        files: a file, pattern or folder, or a list of them; minari:<name> for a Minari data set.
        columns: the column of each state, action, input, time and episode, as a name or with
            column, unit, scale, offset; those in the task's own settings, under columns, come
            first.
        time_step: seconds between rows, where files have no time stamps.
        gap: an interval longer than this many medians means that rows are lost.
        decimal: the sign before decimals in text, a point or a comma.
        smooth: whether positions whose velocity is estimated are smoothed as well.

    Raises:
        ConfigError: for no files, and numbers out of range; the message names the field.

    Examples:
        >>> RecordedConfig("logs/*.csv", columns={"theta": {"column": "angle", "unit": "deg"}}).gap
        1.5
    """

    kind: ClassVar[str] = "recorded"
    has_env: ClassVar[bool] = False

    files: str | tuple[str, ...]
    columns: Mapping[str, Any] = field(default_factory=dict, hash=False)
    time_step: float | None = None
    gap: float = 1.5
    decimal: str = "."
    smooth: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.files:
            raise ConfigError("files", "expected a file, a pattern or a list of them, got none.")
        if self.time_step is not None and not 0 < self.time_step < math.inf:
            raise ConfigError("time_step", f"expected a positive number, got {self.time_step}.")
        if not self.gap > 1.0:
            raise ConfigError("gap", f"expected a number above 1, got {self.gap}.")
        if self.decimal not in (".", ","):
            raise ConfigError("decimal", f"expected '.' or ',', got {self.decimal!r}.")


class RecordedWorld(World):
    """A world that is known from recordings alone: it has no environment.

    Phase 1 takes all its transitions from :attr:`recordings`, and nothing is evaluated in it.
    Velocities that no recording has are estimated.

    Args:
        task: the task.
        recordings: the recordings, in the units of the task's system; velocities may be NaN.
        smooth: whether positions whose velocity is estimated are smoothed as well.
        label: name of the world in messages.

    Raises:
        ConfigError: for recordings of another system, or none.

    Examples:
        >>> import torch
        >>> from phihp_torchrl import get_task
        >>> time = torch.arange(3) * 0.05
        >>> log = Recording(time, torch.zeros(3, 2), torch.zeros(3, 1))
        >>> world = RecordedWorld(get_task("pendulum"), [log])
        >>> world.has_env, len(world.recordings)
        (False, 1)
    """

    kind = RecordedConfig.kind
    has_env = False

    def __init__(
        self,
        task: Task,
        recordings: RecordedData | Sequence[Recording],
        *,
        smooth: bool = True,
        label: str = "recordings",
    ) -> None:
        super().__init__(task)
        given = recordings.recordings if isinstance(recordings, RecordedData) else recordings
        logs = list(given)
        if not logs:
            raise ConfigError("world", "expected at least one recording, got none.")
        check_columns(task.system, logs, "world")
        self.config: RecordedConfig | None = None
        self.label = label
        self.measured = logs
        """The recordings as they were measured, with NaN for what was not."""
        estimate = estimate_velocities(logs, task.system, smooth_positions=smooth)
        for note in estimate.notes():
            _log.warning("%s", note)
        self._recordings = estimate.recordings

    @classmethod
    def from_config(cls, task: Task, config: RecordedConfig) -> RecordedWorld:
        """Read the recordings that ``config`` describes."""
        try:
            data = read_recordings(
                task,
                config.files,
                config.columns,
                time_step=config.time_step,
                gap=config.gap,
                decimal=config.decimal,
            )
        except ConfigError as error:
            raise error.inside("world") from error
        files = config.files if isinstance(config.files, str) else ", ".join(config.files)
        world = cls(task, data, smooth=config.smooth, label=f"recorded {files}")
        world.config = config
        return world

    @property
    def recordings(self) -> list[Recording]:
        return self._recordings

    def make_env(self, *, render: bool = False) -> NoReturn:
        """Refuse: nobody can act in a recording.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("world", f"{self} has recordings alone, nobody can act in it.")

    def __str__(self) -> str:
        return self.label
