"""Cells of a grid for tests: the least they can do, and what they left."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from cluster_check import TINY as LEAST
from grid import CellState, GridConfig, work

ROOT = Path(__file__).parents[3]
PAPER = ROOT / "benchmarks" / "paper"
YAML = yaml.safe_load((PAPER / "config" / "grid.yaml").read_text())
# The number of samples is the cell's.
TINY = (
    *LEAST,
    "progress=false",
    "model.steps_per_iteration=30",
    "policy.updates=8",
    "policy.refit.interval=0",
    "evaluate.video=false",
)


def do(config: GridConfig) -> CellState:
    return work(config, Path())


def words(config: GridConfig) -> list[str]:
    """What the log says happened to a cell, word by word."""
    lines = config.files(Path()).log.read_text().splitlines()
    return [line.rsplit(" ", 1)[1] for line in lines if " INFO grid." in line]


def returns(config: GridConfig) -> dict[str, list[float]]:
    results = json.loads(config.files(Path()).evaluation.read_text())
    return {name: results[name]["returns"] for name in ("planner", "actor") if name in results}
