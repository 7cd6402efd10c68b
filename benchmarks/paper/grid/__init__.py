"""Grids of runs: methods, tasks and seeds, on one machine or a cluster."""

from __future__ import annotations

from grid.cell import Cell, CellFiles
from grid.claim import claim, is_claimed
from grid.config import GridConfig
from grid.keep import keep
from grid.live import LiveTable
from grid.status import CellState, Status, look
from grid.sweep import swept_cells
from grid.worker import work

__all__ = [
    "Cell",
    "CellFiles",
    "CellState",
    "GridConfig",
    "LiveTable",
    "Status",
    "claim",
    "is_claimed",
    "keep",
    "look",
    "swept_cells",
    "work",
]
