"""A run that nothing disturbed."""

from __future__ import annotations

from pathlib import Path

import pytest

from phihp_torchrl.trainers import run

from .run_parts import CONFIG


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbed."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    assert run(CONFIG, path).finished
    return path
