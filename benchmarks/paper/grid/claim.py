"""Claims on cells: of all processes and machines, one works on a cell."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


@contextmanager
def claim(path: Path, wait: float = 0.0) -> Iterator[bool]:
    """Hold the lock at ``path``; the context's value says whether it was to be had.

    The operating system gives the lock up when its process ends, however it ends. Machines must
    share a file system that has locks.

    Args:
        path: the lock file; its directory is made.
        wait: seconds to wait for another process to give it up.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "cell.lock"
        >>> with claim(path) as first, claim(path) as second:
        ...     first, second
        (True, False)
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=wait)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


def is_claimed(path: Path) -> bool:
    """Whether some process holds the lock at ``path``."""
    if not path.exists():
        return False
    with claim(path) as free:
        return not free
