"""The console command ``phihp`` (train, evaluate, identify, export, list), and ``learn``.

Modules are imported when they are used, so that ``--help`` does not import torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from phihp_torchrl.commands.console import main
from phihp_torchrl.commands.letters import use_utf8

if TYPE_CHECKING:
    from phihp_torchrl.commands.job import show_log, tell
    from phihp_torchrl.commands.learning import Learned, learn

__all__ = ["Learned", "learn"]


def __getattr__(name: str) -> Any:
    if name in ("Learned", "learn"):
        from phihp_torchrl.commands import learning

        return getattr(learning, name)
    if name in ("show_log", "tell"):
        from phihp_torchrl.commands import job

        return getattr(job, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
