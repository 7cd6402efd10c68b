"""A cell that takes a second."""

from __future__ import annotations

from pathlib import Path

import pytest
from grid_cells import TINY

from grid import GridConfig


@pytest.fixture
def config(tmp_path: Path) -> GridConfig:
    """A cell that takes a second."""
    return GridConfig(
        method="phihp",
        task="pendulum",
        seed=0,
        share=0.03,
        overrides=TINY,
        allow_dirty=True,
        runs=str(tmp_path / "runs"),
        results=str(tmp_path / "kept"),
        claim_wait=0.0,
    )
