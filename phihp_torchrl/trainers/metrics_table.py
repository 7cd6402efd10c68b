"""The table of metrics of a run, and what of it a resumed run goes on with."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from phihp_torchrl.config import names_file
from phihp_torchrl.trainers.files import write_atomically

_log = logging.getLogger(__name__)

Row = dict[str, str]
"""A row as it stands in the file, without its empty cells."""


class MetricsTable:
    """A CSV file with a row for each unit of work; new metrics become new columns.

    Args:
        path: the file, which is replaced.
        rows: the rows that it begins with.

    Examples:
        >>> import tempfile
        >>> table = MetricsTable(Path(tempfile.mkdtemp()) / "metrics.csv")
        >>> table.append({"unit": 0, "loss": 1.5})
        >>> table.append({"unit": 1, "return": -300.0})
        >>> print(table.path.read_text())
        unit,loss,return
        0,1.5,
        1,,-300.0
        <BLANKLINE>
        >>> read_rows(table.path)
        [{'unit': '0', 'loss': '1.5'}, {'unit': '1', 'return': '-300.0'}]
    """

    def __init__(self, path: Path, rows: Sequence[Row] = ()) -> None:
        self.path = path
        self.rows = [dict(row) for row in rows]
        self._columns = list(dict.fromkeys(name for row in rows for name in row))
        self._write()

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row."""
        new = {name: str(value) for name, value in row.items()}
        self.rows.append(new)
        if names := [name for name in new if name not in self._columns]:
            self._columns += names
            self._write()
            return
        with names_file(self.path), self.path.open("a", newline="", encoding="utf-8") as file:
            self._writer(file).writerow(new)

    def _write(self) -> None:
        text = io.StringIO(newline="")
        if self._columns:
            writer = self._writer(text)
            writer.writeheader()
            writer.writerows(self.rows)
        write_atomically(self.path, text.getvalue())

    def _writer(self, file: Any) -> Any:
        return csv.DictWriter(file, self._columns, lineterminator="\n")


def read_rows(path: Path) -> list[Row]:
    """The whole rows of a table; none of a file that is absent or no table."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            return [
                {k: v for k, v in row.items() if v not in ("", None)}
                for row in reader
                if None not in row  # more cells than columns: no row of ours
            ]
    except (OSError, ValueError, csv.Error):
        return []


def rows_to_keep(path: Path, known: Sequence[Row] | None, unit: int) -> list[Row]:
    """The rows before a checkpoint, by the checkpoint and not by the file, which may be damaged.

    Args:
        path: the file.
        known: the rows that the checkpoint has; ``None`` for one of an earlier version.
        unit: the unit of work that follows it.
    """
    found = read_rows(path)
    if known is None:
        return found[:unit]
    if (have := found[: len(known)]) != list(known):
        wrong = sum(a != b for a, b in zip(have, known, strict=False))
        _log.warning(
            "%s is not what the run has written: of %d rows before its checkpoint %d are missing "
            "and %d are others. All are restored from the checkpoint.",
            path,
            len(known),
            len(known) - len(have),
            wrong,
        )
    return [dict(row) for row in known]
