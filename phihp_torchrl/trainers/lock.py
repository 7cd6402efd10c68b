"""One process at a time works on a run: a lock in its directory, with the name of its owner."""

from __future__ import annotations

import json
import logging
import os
import socket
import time
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers.files import write_atomically

_log = logging.getLogger(__name__)

LOCK, OWNER = ".lock", ".owner.json"
"""The file that is locked, and the one that says who locked it, in the directory of a run."""


class RunLock:
    """A context in which no other process works on a run.

    The operating system holds the lock and gives it up when its process ends, however it ends. So
    the owner's name that a killed process leaves behind locks nothing: it is stale, and replaced.

    Args:
        directory: directory of the run, which must exist.

    Raises:
        ConfigError: on entering, if another process has the run; the message names the process, its
            host and since when it is at work.

    Examples:
        >>> import tempfile
        >>> place = Path(tempfile.mkdtemp())
        >>> with RunLock(place):
        ...     owner(place)["pid"] == os.getpid()
        True
        >>> owner(place)
        {}
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)
        self._lock = FileLock(self.directory / LOCK)

    def __enter__(self) -> RunLock:
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise self._taken() from error
        except PermissionError as error:
            raise ConfigError(str(self.directory), f"cannot be written to: {error}") from error
        except (OSError, NotImplementedError) as error:
            self._without_lock(error)
        try:
            self._replace(owner(self.directory))
        except OSError:  # a full disk
            self._lock.release()
            raise
        return self

    def check(self) -> None:
        """Raise as entering does if another process has the run, and touch nothing."""
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise self._taken() from error
        except (OSError, NotImplementedError):
            return  # entering says what is wrong
        self._lock.release()

    def __exit__(self, *_: object) -> None:
        (self.directory / OWNER).unlink(missing_ok=True)
        self._lock.release()

    def _replace(self, before: dict[str, Any]) -> None:
        """Note the new owner, and say what has become of the one before."""
        ours = {"pid": os.getpid(), "host": socket.gethostname(), "since": _now()}
        if before and before.get("host") == ours["host"]:
            _log.info("%s, which had %s, has ended; its lock is stale.", _name(before), self)
        elif before:
            _log.warning(
                "%s had %s and did not give it up. The file system says that it has ended; if it "
                "goes on, end one of the two.",
                _name(before),
                self,
            )
        write_atomically(self.directory / OWNER, json.dumps(ours) + "\n")

    def _without_lock(self, error: Exception) -> None:
        """Where the file system has no locks, the owner's name is all there is to go by."""
        before = owner(self.directory)
        if before.get("host") == socket.gethostname() and _is_alive(before.get("pid")):
            raise self._taken() from error
        _log.warning(
            "%s cannot be locked (%s): take care that no other process works on it.", self, error
        )

    def _taken(self) -> ConfigError:
        for _ in range(20):  # its owner may be about to write its name
            if found := owner(self.directory):
                break
            time.sleep(0.05)
        return ConfigError(
            str(self.directory),
            f"another process works on this run: {_name(found)}. Wait until it has ended, or end "
            "it; two would write over each other's files.",
        )

    def __str__(self) -> str:
        return str(self.directory)


def owner(directory: Path) -> dict[str, Any]:
    """Who works on a run, or was killed at it: ``pid``, ``host``, ``since``; empty for nobody."""
    try:
        found = json.loads((directory / OWNER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _name(found: dict[str, Any]) -> str:
    if not found:
        return "a process that has not yet given its name"
    return f"process {found.get('pid')} on host {found.get('host')!r}, since {found.get('since')}"


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")


def _is_alive(pid: Any) -> bool:
    if not isinstance(pid, int):
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True
