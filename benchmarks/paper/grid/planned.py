"""The cells that grids were asked for, as ``planned.json`` has them."""

from __future__ import annotations

import json
from pathlib import Path

from grid.cell import Cell
from phihp_torchrl.config import ConfigError


def read_cells(planned: Path, key: str) -> dict[str, Cell]:
    """The cells by their names; none where no grid has noted any.

    Args:
        planned: the file.
        key: the setting that says where it is.

    Raises:
        ConfigError: for a file that cannot be read; without it, every missing run would be lost.
    """
    if not planned.is_file():
        return {}
    try:
        noted = json.loads(planned.read_text())
        if not isinstance(noted, dict):
            raise TypeError(f"a {type(noted).__name__}")
        return {name: Cell(**cell) for name, cell in noted.items()}
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            key, f"expected a description of each cell in {planned}, got {error}."
        ) from error
