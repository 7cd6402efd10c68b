"""Tables of a report, for people as Markdown and for programs as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

from measures import Between
from phihp_torchrl.evaluation import markdown_table, mean_and_std

NOT_RUN = "not run"
"""What stands in a table where there is no run."""


@dataclass(frozen=True)
class Stat:
    """A value for each seed: ``mean ± std (seeds)``.

    Args:
        values: the values; of none, the cell is :data:`NOT_RUN`.
        digits: decimals to show.
        note: what differs from other cells, such as ``"20 samples"``.
    """

    values: tuple[float, ...]
    digits: int = 1
    note: str = ""

    def __str__(self) -> str:
        if not self.values:
            return NOT_RUN
        seeds = f"{len(self.values)}; {self.note}" if self.note else f"{len(self.values)}"
        return f"{mean_and_std(self.values, self.digits)} ({seeds})"

    def columns(self) -> dict[str, float | int | str]:
        """Columns of a CSV file, by what is added to the header."""
        if not self.values:
            return dict.fromkeys((" mean", " std", " seeds"), NOT_RUN)
        mean = sum(self.values) / len(self.values)
        squares = sum((value - mean) ** 2 for value in self.values)
        std = math.sqrt(squares / (len(self.values) - 1)) if len(self.values) > 1 else math.nan
        noted: dict[str, float | int | str] = {" note": self.note} if self.note else {}
        return {" mean": mean, " std": std, " seeds": len(self.values), **noted}


@dataclass(frozen=True)
class Number:
    """One number; ``None`` if nothing was run to have it.

    Args:
        value: the number.
        digits: significant digits to show, or decimals with ``fixed``.
        fixed: whether to show decimals.
    """

    value: float | None
    digits: int = 3
    fixed: bool = False

    def __str__(self) -> str:
        if self.value is None:
            return NOT_RUN
        text = f"{self.value:.{self.digits}{'f' if self.fixed else 'g'}}"
        return text.replace("-", "−") if "e" not in text else text

    def columns(self) -> dict[str, float | str]:
        """Columns of a CSV file."""
        return {"": NOT_RUN if self.value is None else self.value}


@dataclass(frozen=True)
class Interval:
    """A value and the ends of its interval: ``value [low, high]``.

    Args:
        value: the value.
        low: lower end.
        high: upper end.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]".replace("-", "−")

    def columns(self) -> dict[str, float]:
        """Columns of a CSV file, by what is added to the header."""
        return {"": self.value, " low": self.low, " high": self.high}


@dataclass(frozen=True)
class Ends:
    """What a number lies between; ``None`` if nothing was run to know it.

    Args:
        between: its ends.
        seeds: over how many seeds.
    """

    between: Between | None
    seeds: int

    def __str__(self) -> str:
        return NOT_RUN if self.between is None else f"{self.between} ({self.seeds})"

    def columns(self) -> dict[str, float | str]:
        """Columns of a CSV file, by what is added to the header."""
        if self.between is None:
            return dict.fromkeys((" from", " to", " seeds"), NOT_RUN)
        return {" from": self.between.low, " to": self.between.high, " seeds": self.seeds}


TableCell = str | Stat | Number | Interval | Ends


@dataclass(frozen=True)
class Table:
    """A table.

    Args:
        name: of its CSV file.
        header: names of the columns.
        rows: cells; the first column is the row's name.
    """

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[TableCell]]

    def markdown(self) -> str:
        """For people."""
        return markdown_table(self.header, [[str(cell) for cell in row] for row in self.rows])

    def csv(self) -> str:
        """For programs: a column for each number, as it is."""
        columns: list[tuple[str, list[object]]] = []
        for i, title in enumerate(self.header):
            cells = [row[i] for row in self.rows]
            numbers = [cell.columns() for cell in cells if not isinstance(cell, str)]
            for name in dict.fromkeys(name for found in numbers for name in found) or [""]:
                columns.append((title + name, [_value(cell, name) for cell in cells]))
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([title for title, _ in columns])
        writer.writerows(zip(*(values for _, values in columns), strict=True))
        return text.getvalue()


def _value(cell: TableCell, column: str) -> object:
    """What a cell writes into a column; a text fills all columns that numbers are written as."""
    return cell if isinstance(cell, str) else cell.columns().get(column, "")
