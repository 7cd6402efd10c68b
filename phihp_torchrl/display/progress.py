"""What a run says while it goes on: where it is, how long it will take, and what counts."""

from __future__ import annotations

import contextlib
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TextIO

from phihp_torchrl.display.activity import activity
from phihp_torchrl.display.forecast import Forecast
from phihp_torchrl.display.words import duration

INTERVAL = 5.0
"""Seconds between two lines, half of what is promised: a busy machine may wake us late."""
_REFRESH = 1.0
"""Seconds after which the line on a terminal is written anew."""


class Beat:
    """A thread that writes a line now and then, until it is stopped.

    On a terminal the line is written over itself; elsewhere, such as in a file, each stays.

    Args:
        text: returns the line.
        stream: where it is written. Defaults to ``sys.stderr``.
        interval: seconds between two lines that stay.
    """

    def __init__(
        self, text: Callable[[], str], stream: TextIO | None = None, interval: float = INTERVAL
    ) -> None:
        self.stream = stream or sys.stderr
        self.terminal = self.stream.isatty()
        self._text, self._interval = text, interval
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._last = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="progress", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def stop(self) -> None:
        """Write no more."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def say(self, line: str) -> None:
        """Write a line that stays."""
        with self._lock:
            self._last = time.monotonic()
            self._write(f"\x1b[K{line}\n" if self.terminal else f"{line}\n")

    def _run(self) -> None:
        while not self._stop.wait(min(_REFRESH, self._interval / 5)):
            if self.terminal:
                width = shutil.get_terminal_size().columns - 1
                with self._lock:
                    # The cursor goes back, so that a warning is written over this line.
                    self._write(f"\x1b[K{self._text()[:width]}\r")
            elif time.monotonic() - self._last >= self._interval:
                self.say(self._text())

    def _write(self, text: str) -> None:
        # A pipe that nobody reads any more must not end a run.
        with contextlib.suppress(OSError, ValueError):
            self.stream.write(text)
            self.stream.flush()


_loading: Beat | None = None  # the one before a run: nothing else knows of it


@contextlib.contextmanager
def loading(first: str, *, enabled: bool = True, stream: TextIO | None = None) -> Iterator[None]:
    """Say a line at once, and that it takes time until :class:`Progress` takes over.

    Args:
        first: the first line.
        enabled: ``False`` says nothing.
        stream: where lines are written. Defaults to ``sys.stderr``.

    Examples:
        >>> with loading("Loading PyTorch.", stream=sys.stdout):
        ...     pass
        Loading PyTorch.
    """
    global _loading
    if not enabled:
        yield
        return
    start = time.monotonic()
    _loading = Beat(lambda: f"still loading, {duration(time.monotonic() - start)} gone", stream)
    _loading.say(first)
    _loading.start()
    try:
        yield
    finally:
        _end_loading()


def _end_loading() -> None:
    global _loading
    if _loading is not None:
        _loading.stop()
    _loading = None


class Progress:
    """Says where a run is, from a thread of its own that reads what the run tells it.

    There is a line at least every ten seconds, also while one unit of work takes minutes. Nothing
    of the training is read or changed: a run tells names and numbers, and what is being done within
    a unit is read from the stack of the run's thread (:func:`activity`).

    Args:
        expected: seconds that each phase is expected to take, by name in order; ``None`` for a
            phase of which nobody knows.
        enabled: ``False`` says nothing.
        stream: where lines are written. Defaults to ``sys.stderr``.
        interval: seconds between two lines.

    Examples:
        >>> with Progress({"model": 20.0, "policy": 60.0}, stream=sys.stdout) as progress:
        ...     progress.begin("model", (0, 2500), "steps")
        ...     progress.advance((1250, 2500), "error 0.01", seconds=8.0)
        ...     progress.end(seconds=16.0)  # the policy's 60 s were expected by the same measure
        model: 0 of 2,500 steps, 0 % of the run, about 1 min 20 s left
        model: done in 16 s, error 0.01
    """

    def __init__(
        self,
        expected: Mapping[str, float | None],
        *,
        enabled: bool = True,
        stream: TextIO | None = None,
        interval: float = INTERVAL,
    ) -> None:
        self.enabled = enabled
        self.forecast = Forecast(expected)
        self._beat = Beat(self._line, stream, interval)
        self._thread = threading.get_ident()
        self._phase, self._unit, self._number = "", "", ""
        self._done, self._total = 0, 0

    def __enter__(self) -> Progress:
        _end_loading()
        if self.enabled:
            self._beat.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._beat.stop()

    def say(self, line: str) -> None:
        """Say a line that is not about where the run is."""
        if self.enabled:
            self._beat.say(line)

    def restored(self, phase: str, seconds: float) -> None:
        """A phase was done before this run was resumed.

        Args:
            phase: its name.
            seconds: time that it has taken.
        """
        self.forecast.restored(phase, seconds)

    def begin(self, phase: str, progress: tuple[int, int], unit: str) -> None:
        """A phase begins, or goes on in a resumed run.

        Args:
            phase: its name.
            progress: amount of work that is done, and of all work.
            unit: unit of that amount.
        """
        self.forecast.begin(phase, _share(progress))
        self._phase, self._unit = phase, unit
        self._done, self._total = progress
        self.say(self._line(doing=False))

    def advance(self, progress: tuple[int, int], number: str, seconds: float) -> None:
        """A unit of work is done.

        Args:
            progress: amount of work that is done, and of all work.
            number: the number that matters, in words; empty to keep the one before.
            seconds: time that the phase has taken in all.
        """
        self._done, self._total = progress
        self._number = number or self._number
        self.forecast.advance(_share(progress), seconds)

    def end(self, seconds: float) -> None:
        """The phase is done.

        Args:
            seconds: time that it has taken in all.
        """
        self.forecast.end(seconds)
        number = f", {self._number}" if self._number else ""
        self.say(f"{self._phase}: done in {duration(seconds)}{number}")

    def _line(self, *, doing: bool = True) -> str:
        share, left, since = self.forecast.now()
        words = [f"{self._phase}: {self._done:,} of {self._total:,} {self._unit}"]
        now = activity(self._thread) if doing else ""
        if now:
            words.append(f"{now} ({duration(since)})")
        if share is not None:
            words.append(f"{100 * share:.0f} % of the run")
        words.append(left)
        if doing and self._number:
            words.append(self._number)
        return ", ".join(words)


def _share(progress: tuple[int, int]) -> float:
    done, total = progress
    return min(1.0, done / total) if total else 0.0
