"""The command that goes on with a run, as a shell reads it."""

from __future__ import annotations

import shlex
from pathlib import Path

from phihp_torchrl.config import override_lines


def resume_command(path: str | Path) -> str:
    """The command that resumes the run in a directory, quoted for Hydra and for a shell.

    Examples:
        >>> print(resume_command("outputs/run"))
        phihp train resume=outputs/run
        >>> words = shlex.split(resume_command("my runs/a=1,b"))
        >>> words[-1]
        "resume='my runs/a=1,b'"
    """
    return shlex.join(["phihp", "train", *override_lines({"resume": str(path)})])
