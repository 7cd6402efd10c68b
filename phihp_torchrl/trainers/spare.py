"""Whether another process may work beside a run: it has a core, and finds what it works on."""

from __future__ import annotations

import os

from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.run_config import RunConfig

# The part of a core that is idle, at least.
_IDLE = 0.5


def has_idle_core(threads: int, *, begun: bool) -> bool:
    """Whether a core was idle in the last minute that this process does not use.

    Args:
        threads: threads of this process.
        begun: whether it has worked for a minute, so that it is among the load of the machine.

    Examples:
        >>> has_idle_core(threads=1_000_000, begun=True)
        False
    """
    try:
        cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    except (AttributeError, OSError):  # it is not known, as anywhere but on Linux
        return False
    return cores - (max(threads, load) if begun else threads + load) >= _IDLE


def is_importable(config: RunConfig, task: Task) -> bool:
    """Whether another process finds what a task is made of, which no plugin or prompt has."""
    parts = (task.reward, type(task.system))
    return not config.plugins and all(part.__module__ != "__main__" for part in parts)
