"""A call in another Python process, which a core of its own works on, and nobody waits for."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path

_CHILD = "import sys; from phihp_torchrl.compilation.other_process import work; work(*sys.argv[1:])"
# Seconds that a process has to end, since it may be writing.
_GRACE = 5.0
# How far it makes way for others, in the scheduler's levels.
_NICE = 10


class OtherProcess:
    """Calls a function of a module in another process, which ends with this one at the latest.

    Compiling in a thread holds the interpreter for most of its time, so that compiler and work take
    turns; another process needs a core of its own, and nothing of this one. It has a folder of its
    own, :attr:`place`, which is removed with this object.

    Args:
        function: the function, as ``"module:name"``; it gets the folder and the words.
        words: the words.
        place: the folder, for what the process reads and writes, with its output as ``log``.
    """

    def __init__(
        self, function: str, words: Sequence[str], place: tempfile.TemporaryDirectory[str]
    ) -> None:
        self._folder = place
        paths = os.pathsep.join(path for path in sys.path if path)
        command = [sys.executable, "-c", _CHILD, function, str(os.getpid()), place.name, *words]
        with open(self.place / "log", "wb") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": paths},
                start_new_session=True,  # a Ctrl-C of the terminal is not for it
            )
        self._end = weakref.finalize(self, _end, self._process, place)

    @property
    def place(self) -> Path:
        """The folder of the process."""
        return Path(self._folder.name)

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    @property
    def failure(self) -> str:
        """The last line that a failed process has written, which says why; else nothing."""
        if not self._process.poll() or not self._end.alive:  # it was ended
            return ""
        text = (self.place / "log").read_text(errors="replace", encoding="utf-8").strip()
        return (text.splitlines() or ["no reason given"])[-1]

    def wait(self, seconds: float | None = None) -> None:
        """Wait until the process has ended.

        Raises:
            TimeoutError: if it has not after so many seconds; it goes on.
        """
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired as error:
            raise TimeoutError(f"still at work after {seconds} s.") from error

    def end(self) -> None:
        """End the process, whose result nobody waits for any more, and remove its folder."""
        self._end()


def work(function: str, parent: str, place: str, *words: str) -> None:
    """Call the function: what the other process does."""
    watched = int(parent), Path(place)
    threading.Thread(target=_end_with, args=watched, daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(_NICE)
    module, name = function.split(":")
    getattr(import_module(module), name)(place, *words)


def _end_with(parent: int, place: Path) -> None:
    """End this process, and its folder, when its parent has ended without a word."""
    while os.getppid() == parent:
        time.sleep(1.0)
    shutil.rmtree(place, ignore_errors=True)
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)  # with the compilers that it has started
    os._exit(1)


def _end(process: subprocess.Popen[bytes], place: tempfile.TemporaryDirectory[str]) -> None:
    if process.poll() is None:
        _stop(process, "SIGTERM")
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            _stop(process, "SIGKILL")
            process.wait()
    with suppress(OSError):  # a compiler may still be writing
        place.cleanup()


def _stop(process: subprocess.Popen[bytes], name: str) -> None:
    """Send a signal to the process, and to the compilers that it has started."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, getattr(signal, name))
    elif name == "SIGTERM":
        process.terminate()
    else:
        process.kill()
