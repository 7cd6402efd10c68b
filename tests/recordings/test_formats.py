"""Each format gives the same recordings back; damaged files are refused by name."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import read_recordings
from tests.recordings.log_parts import Rig, samples, write_csv, write_hdf5, write_parquet

FORMATS = {"csv": write_csv, "parquet": write_parquet, "h5": write_hdf5}


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_written_is_read(tmp_path: Path, suffix: str, seed: int) -> None:
    columns = samples(seed=seed)
    log = FORMATS[suffix](tmp_path / f"log.{suffix}", columns)
    (recording,) = read_recordings(Rig(), log).recordings
    assert np.array_equal(recording.time, columns["time"])
    for i, name in enumerate(Rig.state_names):
        assert np.array_equal(recording.state[:, i], columns[name])
    assert np.array_equal(recording.action[:, 0], columns["force"])


@given(st.lists(st.floats(-1e9, 1e9), min_size=2, max_size=20))
def test_text_keeps_every_digit(tmp_path_factory: pytest.TempPathFactory, xs: list[float]) -> None:
    columns = {**samples(len(xs)), "x": xs}
    log = write_csv(tmp_path_factory.mktemp("logs") / "log.csv", columns)
    assert read_recordings(Rig(), log).recordings[0].state[:, 0].tolist() == xs


def test_many_files_are_many_episodes_in_order(tmp_path: Path) -> None:
    for k in range(3):
        write_csv(tmp_path / f"log-{k}.csv", {**samples(4), "x": [float(k)] * 4})
    for files in (tmp_path, str(tmp_path / "*.csv"), sorted(tmp_path.iterdir())):
        found = read_recordings(Rig(), files).recordings
        assert [r.episode for r in found] == [0, 1, 2]
        assert [r.state[0, 0].item() for r in found] == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_other_separators_comments_and_spaces(tmp_path: Path, separator: str) -> None:
    log = write_csv(tmp_path / "log.csv", samples(), separator)
    text = "# a rig\n\n" + log.read_text().replace(separator, f" {separator} ")
    log.write_text("\ufeff" + text, encoding="utf-8")
    assert read_recordings(Rig(), log).counts["samples"] == 12


def test_decimal_commas_are_read_when_asked_for(tmp_path: Path) -> None:
    log = write_csv(tmp_path / "log.csv", samples(), ";")
    expected = read_recordings(Rig(), log).recordings[0].state
    log.write_text(log.read_text().replace(".", ","))
    with pytest.raises(ConfigError, match=r"line 2, column 'time': .* set decimal=','"):
        read_recordings(Rig(), log)
    assert torch.equal(read_recordings(Rig(), log, decimal=",").recordings[0].state, expected)


def test_dates_are_seconds_since_the_first(tmp_path: Path) -> None:
    dates = [f"2024-05-01T12:00:{k:02d}.500" for k in range(12)]
    log = write_csv(tmp_path / "log.csv", {**samples(), "time": dates})
    assert read_recordings(Rig(), log).recordings[0].time.tolist() == list(range(12))
    stamps = np.array(dates, dtype="datetime64[ns]")
    log = write_parquet(tmp_path / "log.parquet", {**samples(), "time": stamps})
    assert read_recordings(Rig(), log).recordings[0].time.tolist() == list(range(12))


def test_groups_of_hdf5_are_episodes_in_order(tmp_path: Path) -> None:
    log = tmp_path / "log.h5"
    for k in (10, 9):
        write_hdf5(log, {**samples(5), "x": [float(k)] * 5}, group=f"data/demo_{k}")
    found = read_recordings(Rig(), log).recordings
    assert [(r.episode, r.state[0, 0].item()) for r in found] == [(0, 9.0), (1, 10.0)]
    assert "data/demo_9" in found[0].source


def test_observations_and_actions_in_arrays(tmp_path: Path) -> None:
    task = get_task("pendulum")
    state = torch.linspace(0.0, 1.0, 6)[:, None] * torch.tensor([3.0, -1.0])
    arrays = {"observations": task.observe(state).numpy(), "actions": np.ones((5, 1))}
    log = write_hdf5(tmp_path / "log.hdf5", arrays)
    (recording,) = read_recordings(task, log, time_step=0.05).recordings
    assert torch.allclose(recording.state.float(), state, atol=1e-6)
    assert recording.action.shape == (6, 1)  # the last one is not known and not used
    assert recording.time.tolist() == pytest.approx([0.05 * k for k in range(6)])


def test_a_minari_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari", reason="Minari data sets need the extra logs")
    gymnasium = pytest.importorskip("gymnasium")
    pytest.importorskip("h5py", reason="Minari data sets need the extra logs")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    draw = np.random.default_rng(0)
    angles = draw.uniform(-3.0, 3.0, size=(2, 8, 2)).astype(np.float32)
    expected = [np.stack([np.cos(a), np.sin(a), v], -1) for a, v in angles.transpose(0, 2, 1)]
    episodes = [
        minari.data_collector.EpisodeBuffer(
            id=k,
            observations=observations,
            actions=np.ones((7, 1), dtype=np.float32),
            rewards=[0.0] * 7,
            terminations=[False] * 7,
            truncations=[False] * 6 + [True],
        )
        for k, observations in enumerate(expected)
    ]
    env = gymnasium.make("Pendulum-v1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that nobody can be asked about these data
        minari.create_dataset_from_buffers("rig/pendulum-v0", episodes, env=env)
    task = get_task("pendulum")
    for name in ("minari:rig/pendulum-v0", f"minari:{tmp_path / 'rig' / 'pendulum-v0'}"):
        data = read_recordings(task, name, time_step=0.05)
        assert [len(r) for r in data.recordings] == [8, 8]
        for recording, observations in zip(data.recordings, expected, strict=True):
            assert np.allclose(task.observe(recording.state), observations, atol=1e-5)
    with pytest.raises(ConfigError, match=r"no such data set .* `minari download rig/no-v0`"):
        read_recordings(task, "minari:rig/no-v0", time_step=0.05)


@pytest.mark.parametrize("library", ["pyarrow", "h5py", "minari"])
def test_a_library_that_is_absent_is_named(
    tmp_path: Path, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"pyarrow": "log.parquet", "h5py": "log.h5", "minari": "minari:x/y-v0"}
    (tmp_path / "log.parquet").touch()
    (tmp_path / "log.h5").touch()
    for name in [library, *(m for m in sys.modules if m.startswith(f"{library}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, f"{library}.parquet", None)
    file = names[library] if library == "minari" else tmp_path / names[library]
    with pytest.raises(ConfigError, match=rf"needs {library}; pip install 'phihp_torchrl\[logs\]'"):
        read_recordings(Rig(), file)


def _no_header(path: Path) -> None:
    path.write_text("0,1,2\n1,2,3\n")


def _empty(path: Path) -> None:
    path.write_text("# nothing\n")


def _twice(path: Path) -> None:
    path.write_text("time,x,x\n0,1,2\n")


def _bytes(path: Path) -> None:
    path.write_bytes(b"time,x\n\xff\xfe\x00\n")


def _one_row(path: Path) -> None:
    write_csv(path, samples(1))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (_no_header, "line 1: expected the names of columns, got ['0', '1', '2']"),
        (_empty, "expected a line with the names of columns"),
        (_twice, "two columns have the same name: ['x']"),
        (_bytes, "log.csv cannot be read"),
        (_one_row, "no two consecutive rows can be used"),
    ],
)
def test_a_damaged_text_is_refused(
    tmp_path: Path, write: Callable[[Path], None], message: str
) -> None:
    write(tmp_path / "log.csv")
    with pytest.raises(ConfigError, match=re.escape(message)):
        read_recordings(Rig(), tmp_path / "log.csv")


@pytest.mark.parametrize("suffix", ["parquet", "h5"])
def test_a_damaged_file_is_refused(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip({"parquet": "pyarrow", "h5": "h5py"}[suffix], reason="needs extra logs")
    (tmp_path / f"log.{suffix}").write_text("no such format")
    with pytest.raises(ConfigError, match=rf"log.{suffix} cannot be read"):
        read_recordings(Rig(), tmp_path / f"log.{suffix}")


@pytest.mark.parametrize(
    ("name", "message"), [("none*.csv", "no file matches"), ("log.xlsx", "expected one of")]
)
def test_files_that_cannot_be_are_refused(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "log.xlsx").touch()
    with pytest.raises(ConfigError, match=message):
        read_recordings(Rig(), str(tmp_path / name))
