"""TorchRL's exploration type while plans are made, which threads must not leave changed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

_PLAIN = ("torch.nn.", "phihp_torchrl.", "torchrl.modules.models.", "tensordict.nn.common")
"""Where the classes of modules live that do not read TorchRL's exploration type."""

_lock = threading.Lock()
_inside = 0
_before: Any = None


def reads_exploration_type(module: nn.Module) -> bool:
    """Whether a module, or one in it, may act otherwise by TorchRL's exploration type.

    Examples:
        >>> reads_exploration_type(nn.Sequential(nn.Linear(2, 2), nn.Tanh()))
        False
    """
    return any(not type(each).__module__.startswith(_PLAIN) for each in module.modules())


@contextmanager
def deterministic() -> Iterator[None]:
    """Set TorchRL's exploration type to deterministic, in any number of threads.

    The type is one for the whole process. TorchRL's own context restores what it found, which in
    the second of two threads is what the first has set. Here the first to enter keeps the type and
    the last to leave restores it.

    Examples:
        >>> with set_exploration_type(ExplorationType.RANDOM):
        ...     with deterministic():
        ...         inside = exploration_type()
        ...     inside.name, exploration_type().name
        ('DETERMINISTIC', 'RANDOM')
    """
    global _inside, _before
    with _lock:
        if not _inside:
            _before = exploration_type()
            set_exploration_type(ExplorationType.DETERMINISTIC).__enter__()
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                set_exploration_type(_before).__enter__()
