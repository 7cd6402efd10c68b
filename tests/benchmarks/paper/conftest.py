"""What tests of the paper's benchmarks share: scripts run as from a command line, quick reports."""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from report import write

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


@pytest.fixture(autouse=True)
def _undrawn_reports(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of a report's time goes into its pictures."""
    if "drawn" in request.fixturenames:
        return

    def draw(picture: write.Picture, directory: Path) -> None:
        (directory / f"{picture.name}.svg").write_text("not drawn")
        Figure(figsize=(1, 1)).savefig(directory / f"{picture.name}.png")

    monkeypatch.setattr(write, "_draw", draw)
