"""When a run's state is kept: on the disk, and in memory for a stop that does not wait."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointRotation

from phihp_torchrl.trainers.checkpoints import Frozen, freeze, save_state
from phihp_torchrl.trainers.interrupt import Interrupt

_SHARE = 0.02
"""The most of a run's time that it may take to keep states in memory."""


class Keeper:
    """Saves the states of a run, none of which a stop can cut in the midst.

    The state before a unit of work is kept in memory, so that a stop that gives the unit up can
    save it. Where that takes long, as with a large replay, not every unit has one, and the run
    then goes on from an earlier state.

    Args:
        rotation: the checkpoints of the present phase.
        metadata: description of the states.
        interrupt: the one that may stop the run.
    """

    def __init__(
        self, rotation: CheckpointRotation, metadata: Mapping[str, Any], interrupt: Interrupt
    ) -> None:
        self.rotation, self.metadata, self.interrupt = rotation, metadata, interrupt
        self._frozen: tuple[int, Frozen] | None = None
        self._saved = -1  # the unit before which a state was saved last
        self._last, self._took = 0.0, 0.0

    def save(self, state: Mapping[str, Any], unit: int, place: Path | None = None) -> None:
        """Save a state before unit ``unit``, by default as the latest checkpoint."""
        with self.interrupt.whole():
            save_state(place or self.rotation, state, metadata=self.metadata, step=unit)
            self._frozen, self._saved = None, unit

    def freeze(self, state: Callable[[], Mapping[str, Any]], unit: int) -> None:
        """Keep the state before unit ``unit`` in memory, unless it is saved or that is dear."""
        now = time.monotonic()
        if unit != self._saved and _SHARE * (now - self._last) >= self._took:
            self._frozen = unit, freeze(state())
            self._last, self._took = now, time.monotonic() - now

    def save_frozen(self) -> None:
        """Save the state in memory, if there is one: it is later than all that are saved."""
        if self._frozen is not None:
            unit, state = self._frozen
            save_state(self.rotation, state, metadata=self.metadata, step=unit)
