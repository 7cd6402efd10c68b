"""The columns of a file, whatever its format, with the place of each value for messages."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phihp_torchrl.config import ConfigError

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "nat"})
"""Texts of cells, in lower case, that say that there is no value."""


@dataclass(frozen=True)
class Table:
    """Columns of equal length from one file, or from one episode of it.

    Args:
        source: where it is from, for messages.
        columns: by name, an array or a list of texts ``[rows]``.
        lines: the line of each row in its file; ``None`` where a file has no lines.
        ragged: rows with more or fewer cells than there are columns; all their values are missing.
        decimal: the sign before decimals in texts.
        infinite: how many infinite values were read as missing so far, by column.
    """

    source: str
    columns: Mapping[str, Any]
    lines: Sequence[int] | None = None
    ragged: Sequence[int] = ()
    decimal: str = "."
    infinite: dict[str, int] = field(default_factory=dict, compare=False)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def place(self, row: int) -> str:
        """The file and the line, or the row counted from 1."""
        if self.lines is None:
            return f"{self.source}, row {row + 1}"
        return f"{self.source}, line {self.lines[row]}"

    def numbers(self, name: str) -> NDArray[Any]:
        """The column as float64 ``[rows]``; NaN for missing and for infinite values.

        Dates become seconds since the first of them.

        Raises:
            ConfigError: for a value that is no number; the message names file, line and column.
        """
        values = self.columns[name]
        if isinstance(values, list):
            numbers = self._parse(name, values)
        else:
            numbers = self._from_array(name, np.asarray(values))
        infinite = np.isinf(numbers)
        if infinite.any():
            self.infinite[name] = int(infinite.sum())
            numbers = np.where(infinite, np.nan, numbers)
        return numbers

    def labels(self, name: str) -> list[Any]:
        """The column as it is, to tell episodes apart."""
        values = self.columns[name]
        return list(values) if isinstance(values, list) else np.asarray(values).tolist()

    def _from_array(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        if values.dtype.kind in "fiub":
            return values.astype(np.float64)
        if values.dtype.kind == "M":
            return _seconds(values)
        return self._parse(name, [_text(value) for value in values.tolist()])

    def _parse(self, name: str, cells: list[str]) -> NDArray[Any]:
        texts = [cell.strip() for cell in cells]
        texts = ["nan" if text.lower() in MISSING else text for text in texts]
        if self.decimal != ".":
            texts = [text.replace(self.decimal, ".") for text in texts]
        if not any("_" in text for text in texts):  # 1_000 is a number in Python alone
            try:
                return np.array(texts, dtype=np.str_).astype(np.float64)
            except ValueError:
                pass
        bad = [i for i, text in enumerate(texts) if not _is_number(text)]
        if all(text == "nan" or _is_date(text) for text in texts):
            return _seconds(np.array([_date(text) for text in texts], dtype="datetime64[ns]"))
        first, more = bad[0], len(bad) - 1
        cell = cells[first].strip()
        others = f" (and {more} more in this column)" if more else ""
        hint = ""
        if self.decimal == "." and _is_number(cell.replace(",", ".")):
            hint = " If the comma stands before decimals, set decimal=','."
        raise ConfigError(
            "files",
            f"{self.place(first)}, column {name!r}: expected a number, got {cell!r}{others}.{hint}",
        )


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return "" if value is None else str(value)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def _is_date(text: str) -> bool:
    try:
        return text != "nan" and dt.datetime.fromisoformat(text) is not None
    except ValueError:
        return False


def _date(text: str) -> Any:
    if text == "nan":
        return np.datetime64("NaT")
    moment = dt.datetime.fromisoformat(text)
    if moment.tzinfo is not None:
        moment = moment.astimezone(dt.UTC).replace(tzinfo=None)
    return np.datetime64(moment, "ns")


def _seconds(values: NDArray[Any]) -> NDArray[Any]:
    """Dates as seconds since the first of them, NaN where there is none."""
    stamps = values.astype("datetime64[ns]")
    known = ~np.isnat(stamps)
    seconds = np.full(len(stamps), np.nan)
    if known.any():
        elapsed = (stamps[known] - stamps[known][0]).astype(np.int64)
        seconds[known] = elapsed.astype(np.float64) * 1e-9
    return seconds
