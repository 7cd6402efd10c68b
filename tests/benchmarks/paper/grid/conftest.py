"""A cell that takes a second."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from brief import shorten
from grid_cells import TINY, do

from grid import GridConfig, Status


@pytest.fixture(autouse=True)
def _brief_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


def cell(place: Path) -> GridConfig:
    """A cell that takes a second."""
    return GridConfig(
        method="phihp",
        task="pendulum",
        seed=0,
        share=0.03,
        overrides=TINY,
        allow_dirty=True,
        runs=str(place / "runs"),
        results=str(place / "kept"),
        claim_wait=0.0,
    )


@pytest.fixture
def config(tmp_path: Path) -> GridConfig:
    """A cell that nobody has begun."""
    return cell(tmp_path)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> GridConfig:
    """A finished cell, only to be read."""
    config = cell(tmp_path_factory.mktemp("whole"))
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        assert do(config).status is Status.DONE
    return config


@pytest.fixture
def finished(whole: GridConfig, tmp_path: Path) -> GridConfig:
    """A copy of the finished cell."""
    copied = replace(whole, runs=str(tmp_path / "runs"), results=str(tmp_path / "kept"))
    shutil.copytree(whole.runs, copied.runs)
    shutil.copytree(whole.results, copied.results)
    return copied
