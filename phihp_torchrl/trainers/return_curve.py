"""Returns over real steps, from the table of a run's metrics."""

from __future__ import annotations

import csv
from pathlib import Path

COLLECTING = "while taking real steps"
_WORDS = {
    "collect/return": COLLECTING,
    "return_mean": "while learning",
    "evaluate/actor/return_mean": "the actor alone",
    "evaluate/planner/return_mean": "the agent, planning",
}
"""Metrics that are returns in the real world at some number of real steps, with their words."""


def read_rows(metrics: Path) -> list[dict[str, str]]:
    """The rows of a run's ``metrics.csv``; none if there is no such file."""
    if not metrics.is_file():
        return []
    with metrics.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def return_curve(rows: list[dict[str, str]]) -> dict[str, list[tuple[int, float]]]:
    """Real steps and return of each point, by what earned it.

    Args:
        rows: the rows of ``metrics.csv``.

    Examples:
        >>> rows = [{"real_steps": "250", "collect/return": "-4000"}, {"real_steps": "500"}]
        >>> return_curve(rows)
        {'while taking real steps': [(250, -4000.0)]}
    """
    curve = {
        words: [(int(float(row["real_steps"])), float(row[name])) for row in rows if row.get(name)]
        for name, words in _WORDS.items()
    }
    return {words: points for words, points in curve.items() if points}
