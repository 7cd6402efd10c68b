"""Where a result comes from: the code, the command and the machine that made it."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

_PACKAGES = ("phihp_torchrl", "torch", "torchrl", "tensordict", "gymnasium", "numpy")
_CPUINFO = Path("/proc/cpuinfo")
_GIT_SECONDS = 60
"""On a busy machine, or one whose files are far away, git needs its time."""


def describe_origin(seed: int) -> dict[str, Any]:
    """Describe where a result comes from: seed, time, command, commit, machine and versions.

    The commit is that of :func:`source_commit`. ``dirty`` says whether the source tree has
    uncommitted changes now; it is ``None`` where git does not answer.

    Args:
        seed: the seed of the run.

    Returns:
        Values that can be written as JSON.

    Examples:
        >>> origin = describe_origin(seed=3)
        >>> origin["seed"], sorted(origin["machine"])
        (3, ['cpus', 'gpus', 'memory_gib', 'processor', 'system'])
    """
    versions = {"python": platform.python_version()}
    versions |= {package: package_version(package) for package in _PACKAGES}
    return {
        "seed": seed,
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "commit": source_commit(),
        "dirty": has_changes(),
        "machine": {
            "system": f"{platform.system()} {platform.machine()}",
            "processor": processor_name(),
            "cpus": os.cpu_count(),
            "memory_gib": _memory_gib(),
            "gpus": torch.cuda.device_count(),
        },
        "versions": versions,
    }


def source_commit() -> str | None:
    """Return the commit that the source tree was at when this process first asked.

    A process goes on with the code that it has imported, wherever ``HEAD`` moves meanwhile.
    ``None`` if there is no git or no repository.
    """
    return _first_commit(_source())


def has_changes() -> bool | None:
    """Return whether the source tree has uncommitted changes; ``None`` if git does not answer.

    Tracked files count. ``results/`` does not: a script that writes its results as it goes changes
    them, but not the code that makes them.
    """
    places = (":(top)", ":(top,exclude)results")
    status = ask_git(_source(), "status", "--porcelain", "--untracked-files=no", "--", *places)
    return None if status is None else bool(status)


def ask_git(folder: Path, *arguments: str) -> str | None:
    """Return what git says in a folder; ``None`` if there is no git, no repository or no answer.

    Examples:
        >>> ask_git(Path("/no-such-folder"), "rev-parse", "HEAD") is None
        True
    """
    try:
        done = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=_GIT_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def package_version(package: str = "phihp_torchrl") -> str:
    """Return the version of an installed package, or ``"not installed"``.

    Examples:
        >>> package_version("no-such-package")
        'not installed'
    """
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def origin_text(origin: Mapping[str, Any]) -> str:
    """Return commit and machine as one line, for the foot of a published table.

    Examples:
        >>> origin_text({"commit": "5e6e490c0ffee", "dirty": False,
        ...              "machine": {"cpus": 2, "memory_gib": 23.5, "gpus": 0}})
        'commit 5e6e490, 2 cores, 24 GiB, 0 GPUs'
    """
    return f"commit {commit_text(origin)}, {machine_text(origin)}"


def commit_text(origin: Mapping[str, Any]) -> str:
    """Return the short commit, with a ``+`` if the source tree had uncommitted changes.

    Examples:
        >>> commit_text({"commit": "5e6e490c0ffee", "dirty": True})
        '5e6e490+'
    """
    return str(origin["commit"])[:7] + ("+" if origin["dirty"] else "")


def machine_text(origin: Mapping[str, Any]) -> str:
    """Return the size of the machine as text, and its processor where that was recorded.

    Examples:
        >>> machine = {"cpus": 2, "memory_gib": 23.5, "gpus": 0}
        >>> machine_text({"machine": machine})
        '2 cores, 24 GiB, 0 GPUs'
        >>> machine_text({"machine": {**machine, "processor": "AMD EPYC"}})
        '2 cores (AMD EPYC), 24 GiB, 0 GPUs'
    """
    machine = origin["machine"]
    memory = machine["memory_gib"]  # None on systems that do not report it
    size = "memory unknown" if memory is None else f"{memory:.0f} GiB"
    name = machine.get("processor")  # runs of earlier versions do not say it
    kind = f" ({name})" if name else ""
    return f"{machine['cpus']} cores{kind}, {size}, {machine['gpus']} GPUs"


@cache
def processor_name() -> str:
    """Return the name of the processor, or ``""`` where the system does not say it.

    Python itself knows none on most Linux systems.
    """
    try:
        lines = _CPUINFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):  # not every system reports its memory
        return None


def _source() -> Path:
    return Path(__file__).parent


@cache
def _first_commit(folder: Path) -> str | None:
    return ask_git(folder, "rev-parse", "HEAD")
