"""The configurations of the paper's benchmarks."""

from __future__ import annotations

from pathlib import Path

import pytest
from bare_keys import bare_keys
from grid_cells import PAPER


@pytest.mark.parametrize("path", sorted((PAPER / "config").rglob("*.yaml")), ids=lambda p: p.stem)
def test_every_key_has_a_comment_above_it(path: Path) -> None:
    assert not bare_keys(path)
