"""A rig whose logs the tests write, and ways to write them in each format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from phihp_torchrl import System


class Rig(System):
    """A cart with a turning arm, of which nothing is known but the names."""

    state_names, action_names = ("x", "angle", "x_dot", "angle_dot"), ("force",)
    angles = ("angle",)
    velocity_of = {"x": "x_dot", "angle": "angle_dot"}


class Tank(System):
    state_names, action_names = ("level",), ("pump",)


class OpenTank(Tank):
    """It rains into it."""

    input_names = ("rain",)


def samples(count: int = 12, seed: int = 0) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    values = {name: draw.normal(size=count) for name in (*Rig.state_names, "force")}
    return {"time": 0.1 * np.arange(count), **values}


def write_csv(path: Path, columns: Mapping[str, Sequence[object]], separator: str = ",") -> Path:
    lines = [separator.join(columns)]
    lines += [
        separator.join(x if isinstance(x, str) else repr(float(x)) for x in row)  # type: ignore
        for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_parquet(path: Path, columns: Mapping[str, Sequence[object]]) -> Path:
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet needs the extra logs")
    parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet needs the extra logs")
    parquet.write_table(pyarrow.table(dict(columns)), path)
    return path


def write_hdf5(path: Path, columns: Mapping[str, Sequence[object]], group: str = "") -> Path:
    h5py = pytest.importorskip("h5py", reason="HDF5 needs the extra logs")
    with h5py.File(path, "a") as file:
        for name, values in columns.items():
            file[f"{group}/{name}"] = values
    return path
