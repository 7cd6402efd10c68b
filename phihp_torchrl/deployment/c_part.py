"""One part of a task's registers in C: the functions that it needs, and where they are called."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CPart:
    """What a part of a task's registers contributes to a C file.

    The calls are expressions of C in which ``memory`` points to the memory of the file.

    Args:
        source: tables and static functions. Parts with the same source share it.
        move: the call that moves the registers by one step, after ``memory->command`` was sent.
        take: for a signal, the call that reads what is given under its key, and returns 1 if that
            is missing or refused.
        limit: the call that brings ``memory->command`` into the limits of the part.

    Examples:
        >>> CPart(source="", move="move_up(memory->registers + 2, 4, 1)").take
        ''
    """

    source: str
    move: str
    take: str = ""
    limit: str = ""
