"""What a spawned process would get of an object, without a process."""

from __future__ import annotations

import io
import os
import pickle
from multiprocessing import popen_spawn_posix
from multiprocessing.context import set_spawning_popen
from multiprocessing.reduction import ForkingPickler
from typing import Any


class _Child:
    """Takes the open files of the tensors that are sent, as a child that is about to be spawned."""

    DupFd = popen_spawn_posix._DupFd

    def __init__(self) -> None:
        self.files: list[int] = []

    def duplicate_for_child(self, file: int) -> int:
        self.files.append(file)
        return file


def send(thing: Any) -> Any:
    """Return a copy; raise if a child could not read what is sent to it.

    A tensor that nobody keeps is sent as a file that is closed at once, and whose number the next
    tensor gets.
    """
    child, sent = _Child(), io.BytesIO()
    set_spawning_popen(child)
    try:
        ForkingPickler(sent, pickle.HIGHEST_PROTOCOL).dump(thing)
    finally:
        set_spawning_popen(None)
    assert child.files, "tensors are sent as files"
    assert len(child.files) == len(set(child.files)), "two tensors are sent as one file"
    for file in child.files:
        os.fstat(file)
    return pickle.loads(pickle.dumps(thing))
