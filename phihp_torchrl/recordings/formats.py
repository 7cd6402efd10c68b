"""Readers of CSV, Parquet, HDF5 and Minari; the heavy libraries are imported when needed."""

from __future__ import annotations

import csv
import glob
import importlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings.tables import Table

MINARI = "minari:"
"""Before the name of a Minari data set."""

_TEXT = (".csv", ".tsv", ".txt", ".log")
_PARQUET = (".parquet", ".pq")
_HDF5 = (".h5", ".hdf5", ".hdf")
_SEPARATORS = (",", ";", "\t", "|")


def find_files(files: str | Path | Sequence[str | Path]) -> list[str]:
    """List the files that names, patterns and folders stand for, sorted within each.

    Raises:
        ConfigError: for a pattern that no file matches, and for a format that is not known.
    """
    found: list[str] = []
    for each in [files] if isinstance(files, (str, Path)) else files:
        text = str(each)
        if text.startswith(MINARI):
            found.append(text)
            continue
        path = Path(text).expanduser()
        if path.is_dir():
            names = [str(p) for p in sorted(path.iterdir()) if p.suffix.lower() in _known()]
        elif path.exists():
            names = [str(path)]
        else:
            names = sorted(glob.glob(str(path), recursive=True))
        if not names:
            raise ConfigError("files", f"no file matches {text!r} (from {Path.cwd()}).")
        found += names
    if not found:
        raise ConfigError("files", "expected a file, a pattern or a list of them, got none.")
    for name in found:
        if not name.startswith(MINARI) and Path(name).suffix.lower() not in _known():
            raise ConfigError(
                "files", f"{name}: expected one of {list(_known())}, or {MINARI}<data set>."
            )
    return found


def read_tables(name: str, needed: Iterable[str], *, decimal: str = ".") -> Iterator[Table]:
    """Read the tables of a file: one, or one for each episode in it.

    Args:
        name: the file, or ``minari:`` and the name or path of a data set.
        needed: columns that a group of an HDF5 file must have to be an episode.
        decimal: the sign before decimals in text.

    Raises:
        ConfigError: for a file that cannot be read, or a library that is not installed.
    """
    if name.startswith(MINARI):
        yield from _read_minari(name)
        return
    suffix = Path(name).suffix.lower()
    reader = _read_text if suffix in _TEXT else _read_parquet if suffix in _PARQUET else _read_hdf5
    options: dict[str, Any] = {}
    if reader is _read_text:
        options["decimal"] = decimal
    if reader is _read_hdf5:
        options["needed"] = list(needed)
    try:
        yield from reader(Path(name), **options)
    except ConfigError:
        raise
    except (OSError, ValueError, KeyError, csv.Error) as error:  # pyarrow's are among these
        raise ConfigError("files", f"{name} cannot be read: {error}") from error


def _known() -> tuple[str, ...]:
    return (*_TEXT, *_PARQUET, *_HDF5)


def _read_text(path: Path, decimal: str) -> Iterator[Table]:
    """Comma-, semicolon-, tab- or bar-separated text with a header; # begins a comment line."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = file.readlines()
    kept = [(i + 1, s) for i, s in enumerate(lines) if s.strip() and not s.startswith("#")]
    if not kept:
        raise ConfigError("files", f"{path}: expected a line with the names of columns.")
    separator = max(_SEPARATORS, key=kept[0][1].count)
    rows = list(csv.reader((s for _, s in kept), delimiter=separator, skipinitialspace=True))
    header = [name.strip() for name in rows[0]]
    if all(_plain_number(name) for name in header):
        raise ConfigError(
            "files", f"{path}, line {kept[0][0]}: expected the names of columns, got {header}."
        )
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise ConfigError("files", f"{path}: two columns have the same name: {twice}.")
    if len(rows) != len(kept):
        raise ConfigError("files", f"{path}: a quoted text goes over the end of a line.")
    body, width = rows[1:], len(header)
    ragged = [i for i, row in enumerate(body) if len(row) != width]
    for i in ragged:
        body[i] = [""] * width
    columns = {name: [row[j] for row in body] for j, name in enumerate(header)}
    numbers = [number for number, _ in kept[1:]]
    yield Table(str(path), columns, lines=numbers, ragged=ragged, decimal=decimal)


def _plain_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _read_parquet(path: Path) -> Iterator[Table]:
    data = library("pyarrow.parquet", f"{path}").read_table(path)
    columns = {}
    for name in data.column_names:
        column = data.column(name)
        columns[name] = column.to_numpy()  # nulls among numbers become NaN
    yield Table(str(path), columns)


def _read_hdf5(path: Path, needed: Sequence[str]) -> Iterator[Table]:
    """Each group that has all needed columns is an episode; columns are paths below the group."""
    h5py = library("h5py", f"{path}")
    with h5py.File(path, "r") as file:
        groups = [("", file)]
        file.visititems(
            lambda name, item: groups.append((name, item)) if isinstance(item, h5py.Group) else None
        )
        tables = {name: _datasets(h5py, group) for name, group in groups}
        found = [name for name, columns in tables.items() if set(needed) <= set(columns)]
        if not found:  # choose_columns will say what the largest group has
            found = [max(tables, key=lambda name: len(tables[name]))]
        for name in sorted(found, key=_natural):
            columns = {each: data[()] for each, data in tables[name].items()}
            yield _of_arrays(f"{path}:/{name}" if name else str(path), columns)


def _datasets(h5py: Any, group: Any) -> dict[str, Any]:
    """Arrays of numbers below a group, by path; the columns of two-dimensional ones apart."""
    found: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim in (1, 2) and item.dtype.kind in "fiubS":
            if item.ndim == 1:
                found[name] = item
            else:
                found.update({f"{name}[{j}]": _Part(item, j) for j in range(item.shape[1])})

    group.visititems(add)
    return found


class _Part:
    """One column of a two-dimensional data set, read when asked for."""

    def __init__(self, item: Any, index: int) -> None:
        self.item, self.index = item, index

    def __getitem__(self, key: Any) -> Any:
        return self.item[:, self.index]


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort demo_10 after demo_9."""
    digits = "".join(c if c.isdigit() else " " for c in name).split()
    return [(int(d), "") for d in digits] or [(-1, name)]


def _of_arrays(source: str, columns: dict[str, Any]) -> Table:
    """A table of arrays; those one shorter than the longest miss a last value, others are left."""
    longest = max((len(values) for values in columns.values()), default=0)
    kept = {}
    for name, values in columns.items():
        if len(values) == longest:
            kept[name] = values
        elif len(values) == longest - 1 and np.asarray(values).dtype.kind in "fiub":
            # There is no command after the last of N + 1 states.
            kept[name] = np.append(np.asarray(values, dtype=np.float64), np.nan)
    return Table(source, kept)


def _read_minari(name: str) -> Iterator[Table]:
    """Observations, actions and, where there are some, infos; a data set's episodes in order."""
    minari = library("minari", name)
    label = name.removeprefix(MINARI)
    try:
        place = Path(label)
        if place.is_dir():
            data = minari.MinariDataset(place / "data" if (place / "data").is_dir() else place)
        else:
            data = minari.load_dataset(label)
    except (FileNotFoundError, ValueError, KeyError, ImportError) as error:
        raise ConfigError(
            "files",
            f"{name}: no such data set on this machine ({error}); get it with "
            f"`minari download {label}`.",
        ) from error
    for episode in data.iterate_episodes():
        columns: dict[str, Any] = {}
        for key in ("observations", "actions", "infos"):
            _flatten(key, getattr(episode, key, None), columns)
        yield _of_arrays(f"{name}, episode {episode.id}", columns)


def _flatten(name: str, value: Any, into: dict[str, Any]) -> None:
    """Name the numbers of nested arrays: observations[0], observations/joint[1], actions[0]."""
    if isinstance(value, dict):
        for key, item in value.items():
            _flatten(f"{name}/{key}", item, into)
        return
    if value is None:
        return
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        return
    if array.ndim == 1:
        into[name] = array
        return
    flat = array.reshape(len(array), -1)
    into.update({f"{name}[{j}]": flat[:, j] for j in range(flat.shape[1])})


def library(name: str, what: str) -> Any:
    """Import a library of the extra ``logs``.

    Raises:
        ConfigError: if it is not installed; the message says how to get it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            "files",
            f"{what}: reading it needs {name.split('.')[0]}; "
            f"pip install 'phihp_torchrl[logs]' ({error}).",
        ) from error
