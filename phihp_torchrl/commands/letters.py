"""Letters that the locale lacks: names of files, settings and tables may have any."""

from __future__ import annotations

import os
import sys

_RESTARTED = "PHIHP_UTF8"
"""The variable by which a process knows that it was started anew."""


def use_utf8() -> None:
    """Start this process anew in Python's UTF-8 mode, if the locale's encoding is another.

    A name of a file such as ``outputs/größe`` cannot be said in ASCII, nor the minus sign of a
    table. What the terminal cannot show becomes a question mark.

    Examples:
        >>> use_utf8()  # here it is UTF-8
    """
    if sys.getfilesystemencoding() == "utf-8" or os.environ.get(_RESTARTED):
        return
    environment = {**os.environ, "PYTHONUTF8": "1", _RESTARTED: "1"}
    environment.setdefault("PYTHONIOENCODING", f"{sys.stdout.encoding}:replace")
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)
