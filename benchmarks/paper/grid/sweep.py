"""All cells of a grid, as Hydra's sweep will launch them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from grid.cell import CellFiles
from grid.config import GridConfig
from phihp_torchrl.config import from_mapping, override_key, parse_overrides


def swept_cells(base: Mapping[str, Any], overrides: Sequence[str], root: Path) -> list[CellFiles]:
    """The cells that a multirun will launch, in its order.

    Args:
        base: the composed configuration, without Hydra's own part.
        overrides: the command line; each ``key=a,b`` in it makes the grid larger.
        root: directory that relative ones are in.

    Raises:
        ConfigError: for the first cell with a wrong value, by its key.
    """
    parsed = parse_overrides(overrides)
    sweeps = {override_key(o): list(o.sweep_iterator()) for o in parsed if o.is_sweep_override()}
    cells = []
    for values in itertools.product(*sweeps.values()):
        chosen = {key: _plain(value) for key, value in zip(sweeps, values, strict=True)}
        config = from_mapping(GridConfig, {**base, **chosen})
        cells.append(config.files(root))
    return cells


def _plain(value: Any) -> Any:
    """A value as YAML would have it; Hydra wraps quoted texts."""
    return getattr(value, "text", value)
