"""Whether a core is to spare, for work that is done beside a run."""

from __future__ import annotations

import os

# The part of a core that is idle, at least.
_IDLE = 0.5


def has_idle_core(threads: int) -> bool:
    """Whether a core was idle in the last minute that this process does not use.

    Args:
        threads: threads of this process.

    Examples:
        >>> has_idle_core(threads=1_000_000)
        False
    """
    try:
        return len(os.sched_getaffinity(0)) - max(threads, os.getloadavg()[0]) >= _IDLE
    except (AttributeError, OSError):  # it is not known, as anywhere but on Linux
        return False
