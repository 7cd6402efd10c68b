"""Files of a run that are whole or not there, in a folder that nothing leads out of."""

from __future__ import annotations

import os
import re
import stat
import uuid
from pathlib import Path

from phihp_torchrl.config import ConfigError, names_file

STAGE = ".stage"
"""Ending of files that are being written."""

_CLIENTS_LOG = re.compile(r"wandb/[^/]+/logs/debug-core\.log")
_SERVICES_LOG = re.compile(r"core-debug-\w+\.log")
"""A link that wandb's client leaves in the folder of each session, and the file it leads to."""


def write_atomically(path: Path, text: str) -> None:
    """Replace the file at ``path`` in one step: readers see the old text or the new."""
    # A name that nobody can know, and a file that must be new: no link is written through.
    stage = path.with_name(f".{path.name}.{uuid.uuid4().hex}{STAGE}")
    try:
        with names_file(path):
            with stage.open("x", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.replace(stage, path)
    finally:
        stage.unlink(missing_ok=True)


def check_contained(directory: str | Path) -> None:
    """Refuse a folder with links that lead out of it, and with what is neither file nor folder.

    A run writes into its folder and removes old files there, which such a link would lead
    elsewhere. The link that wandb's client leaves to the log of its own service may stay: it lies
    in the folder of a session that has ended, to which nothing is written any more.

    Raises:
        ConfigError: for the first such entry.
    """
    top = Path(directory)
    root = top.resolve()
    for parent, folders, names in os.walk(top):  # which follows no links
        for path in (Path(parent, name) for name in (*folders, *names)):
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                if not (path.resolve().is_relative_to(root) or _is_clients(path, top)):
                    raise ConfigError(
                        str(path), f"a link out of the folder of the run, to {os.readlink(path)}."
                    )
            elif not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise ConfigError(str(path), "expected a file or a folder, it is neither.")


def _is_clients(link: Path, top: Path) -> bool:
    """Whether a link is that of wandb's client to the log of its service."""
    place, target = link.relative_to(top).as_posix(), Path(os.readlink(link)).name
    return bool(_CLIENTS_LOG.fullmatch(place) and _SERVICES_LOG.fullmatch(target))


def remove_stages(directory: Path) -> None:
    """Remove what killed processes were writing."""
    for path in directory.glob(f".*{STAGE}"):
        path.unlink(missing_ok=True)
