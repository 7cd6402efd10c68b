"""Errors of the operating system that say which file, and what to do."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager

_REMEDIES = {
    errno.ENOSPC: "Make room there, or choose another disk.",
    errno.EDQUOT: "Your quota there is used up: make room, or choose another disk.",
    errno.EFBIG: "This process may not write files of that size: raise the limit (ulimit -f).",
    errno.EACCES: "This user may not do that there: choose another folder, or change its rights.",
    errno.EPERM: "This user may not do that there: choose another folder, or change its rights.",
    errno.EROFS: "Nothing can be written there: choose another folder.",
}


@contextmanager
def names_file(path: str | os.PathLike[str]) -> Iterator[None]:
    """A context in which an error of the system that names no file names this one.

    Python names the file that cannot be opened, but not the one that cannot be written to, as where
    a disk is full.

    Args:
        path: the file or folder.

    Examples:
        >>> with names_file("runs/one/metrics.csv"):
        ...     raise OSError(28, "No space left on device")
        Traceback (most recent call last):
        ...
        OSError: [Errno 28] No space left on device: 'runs/one/metrics.csv'
    """
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = os.fspath(path)
        raise


def file_error(error: OSError) -> str:
    """An error of the system in words: which file, why, and what to do.

    Examples:
        >>> file_error(OSError(28, "No space left on device", "runs/one/metrics.csv"))
        'runs/one/metrics.csv: No space left on device. Make room there, or choose another disk.'
        >>> file_error(OSError("the pipe is broken"))
        'a file cannot be written or read: the pipe is broken.'
    """
    place = error.filename or "a file cannot be written or read"
    reason = str(error.strerror or error).rstrip(".")
    remedy = _REMEDIES.get(error.errno or 0)
    notes = getattr(error, "__notes__", ())
    return " ".join([f"{place}: {reason}.", *([remedy] if remedy else []), *notes])
