"""What a thread is doing, read from its stack by another one that disturbs nothing."""

from __future__ import annotations

import sys

_COMPILER = ("torch._inductor.compile_fx", "torch._dynamo.convert_frame")
"""Modules that are on the stack while a graph is compiled, and not while it runs."""


def activity(thread: int) -> str:
    """What a thread is doing, in words; empty if its stack says nothing of it.

    A module that does long work has a global text ``DOING``. The outermost one on the stack counts,
    and a compilation wherever it is found. Only names of modules are read, so the state of a
    training is not touched, and a thread that is in the midst of a fit needs to do nothing for it.

    Args:
        thread: the identifier of the thread, as :func:`threading.get_ident` returns it.

    Examples:
        >>> import threading
        >>> DOING = "counting to three"
        >>> found = []
        >>> ours = threading.get_ident()
        >>> other = threading.Thread(target=lambda: found.append(activity(ours)))
        >>> other.start(), other.join()
        (None, None)
        >>> found
        ['counting to three']
    """
    frame = sys._current_frames().get(thread)
    doing, compiling = "", False
    while frame is not None:
        names = frame.f_globals
        doing = names.get("DOING", doing)
        compiling |= names.get("__name__") in _COMPILER
        frame = frame.f_back
    if compiling:
        return f"{doing}: compiling for it" if doing else "compiling"
    return doing
