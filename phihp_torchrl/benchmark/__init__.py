"""Grids of runs: methods, tasks and seeds, on one machine or a cluster."""

from __future__ import annotations

from phihp_torchrl.benchmark.cell import Cell, CellFiles
from phihp_torchrl.benchmark.claim import claim, is_claimed
from phihp_torchrl.benchmark.config import BenchmarkConfig, MethodConfig
from phihp_torchrl.benchmark.grid import grid
from phihp_torchrl.benchmark.keep import keep
from phihp_torchrl.benchmark.live import LiveTable
from phihp_torchrl.benchmark.status import CellState, Status, look
from phihp_torchrl.benchmark.worker import work

__all__ = [
    "BenchmarkConfig",
    "Cell",
    "CellFiles",
    "CellState",
    "LiveTable",
    "MethodConfig",
    "Status",
    "claim",
    "grid",
    "is_claimed",
    "keep",
    "look",
    "work",
]
