"""How the cells of a grid stand, in words: a table, a count, and the errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from grid.cell import CellFiles
from grid.status import CellState, Status


def summary(states: Sequence[CellState]) -> str:
    """How many cells there are of each status."""
    counts = {status: sum(s.status is status for s in states) for status in Status}
    parts = [f"{count} {status.value}" for status, count in counts.items() if count]
    return f"{len(states)} cells: " + ", ".join(parts)


def table(states: Mapping[CellFiles, CellState]) -> list[str]:
    r"""Lines of a table: a row for each method, task and number of samples, a column for each seed.

    Examples:
        >>> from grid.cell import Cell
        >>> from pathlib import Path
        >>> files = [CellFiles(Cell("td3", "acrobot", s), Path("a"), Path("b")) for s in (0, 1)]
        >>> states = [CellState(Status.DONE, "-91.0"), CellState(Status.WAITING)]
        >>> print("\n".join(table(dict(zip(files, states)))))
        method  task     samples  label    seed 0      seed 1
        td3     acrobot           default  done -91.0  waiting
    """
    seeds = sorted({files.cell.seed for files in states})
    rows: dict[tuple[str, ...], dict[int, str]] = {}
    for files, state in states.items():
        cell = files.cell
        key = (cell.method, cell.task, str(cell.samples or ""), cell.label)
        # An error is told in full when all is over.
        detail = "" if state.status is Status.FAILED else state.detail
        rows.setdefault(key, {})[cell.seed] = f"{state.status.value} {detail}".rstrip()
    header = ["method", "task", "samples", "label", *(f"seed {seed}" for seed in seeds)]
    lines = [header, *([*key, *(row.get(s, "") for s in seeds)] for key, row in rows.items())]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return [
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]


def failures(states: Mapping[CellFiles, CellState]) -> list[str]:
    """A line for each cell that failed: its name, its error and where more is."""
    return [
        f"{files.cell.name} failed: {state.detail} (see {files.log})"
        for files, state in states.items()
        if state.status is Status.FAILED
    ]
