"""Ctrl-C and SIGTERM: finish the current unit of work, then stop."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType
from typing import Any

_log = logging.getLogger(__name__)


class Interrupt:
    """A context that records the first SIGINT or SIGTERM; the second one stops at once.

    Outside the main thread, where Python allows no signal handlers, it has no effect.

    Examples:
        >>> import os, signal
        >>> with Interrupt() as interrupt:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        ...     interrupt.signal == signal.SIGTERM
        True
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._previous: dict[int, Any] = {}

    def __bool__(self) -> bool:
        return self.signal is not None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        _log.warning("Stopping after this unit of work and its checkpoint; again to stop at once.")
