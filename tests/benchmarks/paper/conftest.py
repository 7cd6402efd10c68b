"""What tests of the paper's benchmarks share: scripts run as from the command line."""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PAPER = Path(__file__).parents[3] / "benchmarks" / "paper"


@pytest.fixture
def run_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Run ``python benchmarks/paper/<name>.py <arguments>``, in an empty directory."""
    monkeypatch.chdir(tmp_path)
    # What a script sets for its workers must not reach the tests after it.
    for name in ("OMP_NUM_THREADS", "PYTHONPATH"):
        monkeypatch.setenv(name, os.environ.get(name, ""))

    def run(name: str, *arguments: str) -> None:
        path = str(PAPER / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [path, *arguments])
        runpy.run_path(path, run_name="__main__")

    return run
