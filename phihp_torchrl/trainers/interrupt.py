"""Ctrl-C and SIGTERM: finish the unit of work in hand if it ends soon, or else give it up."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

_log = logging.getLogger(__name__)

GRACE = 3.0
"""Seconds that a unit of work has to end after a stop was asked for."""
_AGAIN = 1.0  # seconds until a stop is tried again that some library has swallowed


class Abandoned(KeyboardInterrupt):
    """Raised in a unit of work that a stop does not wait for.

    Libraries let a KeyboardInterrupt pass where they would handle an error.
    """


class Interrupt:
    """A context that notes the first SIGINT or SIGTERM; the second one stops at once.

    If the unit of work in hand (:meth:`work`) has not ended after ``grace`` seconds, it gets
    :class:`Abandoned`, and nothing that it has done counts. Outside the main thread, where Python
    allows no signal handlers, this has no effect.

    Args:
        grace: seconds that a unit of work has to end.

    Examples:
        >>> import os, signal, time
        >>> with Interrupt(grace=0.1) as interrupt:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        ...     try:
        ...         with interrupt.work():
        ...             time.sleep(60.0)
        ...     except Abandoned:
        ...         interrupt.signal == signal.SIGTERM
        True
    """

    def __init__(self, grace: float = GRACE) -> None:
        self.signal: int | None = None
        self.grace = grace
        self._previous: dict[int, Any] = {}
        self._may_end = False

    def __bool__(self) -> bool:
        return self.signal is not None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
            if hasattr(signal, "SIGALRM"):
                self._previous[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._end)
        return self

    def __exit__(self, *_: object) -> None:
        self._wait_no_longer()
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    @contextlib.contextmanager
    def work(self) -> Iterator[None]:
        """What may be given up.

        Raises:
            Abandoned: if a stop was asked for and the work does not end in time.
        """
        self._may_end = True
        try:
            yield
        finally:
            self._may_end = False
            self._wait_no_longer()

    @contextlib.contextmanager
    def whole(self) -> Iterator[None]:
        """What must not be cut in the midst, within :meth:`work`."""
        before, self._may_end = self._may_end, False
        try:
            yield
        finally:
            self._may_end = before

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self.grace, _AGAIN)
        _log.warning(
            "Stopping. What is in hand has %g s to end; else it is given up, and done again when "
            "the run goes on. Once more to stop at once.",
            self.grace,
        )

    def _end(self, number: int, frame: FrameType | None) -> None:
        if self._may_end:
            raise Abandoned

    def _wait_no_longer(self) -> None:
        if self.signal is not None and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
