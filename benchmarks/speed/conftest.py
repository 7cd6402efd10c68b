"""What every benchmark shares: one thread, and one table at the end."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import torch
from race import figures

from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text

RESULTS = Path(__file__).parents[2] / "results" / "benchmarks"
HEAD = (
    "# Benchmarks\n\n"
    "Made by `make bench`, which replaces the tables of the benchmarks that it ran. Contenders "
    "take turns; *ms* is the median over rounds, *ratio* the median over rounds of the time a "
    "contender took to the time the first, ours, took in the same round. Times are CPU time of the "
    "one thread that there is.\n\n"
)

torch.set_num_threads(1)
torch.set_flush_denormal(True)
_sections: dict[str, dict] = {}
ORIGIN = describe_origin(seed=0)


@pytest.fixture
def report():
    """``report(title, race, note)`` puts a race into the table and returns its ratios."""

    def add(title, milliseconds, note, work=1.0):
        rows = figures(milliseconds, work)
        cells = [[row["contender"], f"{row['ms']:.4g}", f"{row['ratio']:.2f}"] for row in rows]
        rounds = len(next(iter(milliseconds.values())))
        _add(title, f"{note} {rounds} rounds.", ["contender", "ms", "ratio"], cells)
        return {row["contender"]: row["ratio"] for row in rows}

    return add


@pytest.fixture
def report_memory():
    """``report_memory(title, bytes, note)`` puts a size into the table."""

    def add(title, size, note):
        _add(title, note, ["peak", "GB"], [["resident memory", f"{size / 1e9:.2f}"]])

    return add


def _add(title, note, header, cells):
    load = os.getloadavg()[0]
    machine = f"{origin_text(ORIGIN)}, load {load:.1f}, torch {torch.__version__}"
    _sections[title] = {"note": note, "machine": machine, "header": header, "rows": cells}


def pytest_terminal_summary(terminalreporter):
    """Print the tables, and write them beside those of earlier runs."""
    if not _sections:
        return
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / "benchmarks.json"
    known = json.loads(path.read_text()) if path.is_file() else {}
    known |= _sections
    path.write_text(json.dumps(known, indent=2, ensure_ascii=False) + "\n")
    cost = "## How the cost of a plan grows\n\n![cost](cost.png)\n"
    (RESULTS / "README.md").write_text(HEAD + "".join(map(_text, known.items())) + cost)
    terminalreporter.write("\n" + "".join(map(_text, _sections.items())))


def _text(item):
    title, section = item
    table = markdown_table(section["header"], section["rows"])
    return f"## {title}\n\n{section['note']} ({section['machine']})\n\n{table}\n"
