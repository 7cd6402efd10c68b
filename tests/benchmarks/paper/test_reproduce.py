"""One published number, made again."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from brief import shorten
from grid_cells import TINY, do

import reproduce
from grid import CellFiles, GridConfig, Status


@pytest.fixture(scope="module")
def committed(tmp_path_factory: pytest.TempPathFactory) -> CellFiles:
    """A finished cell, only to be read."""
    place = tmp_path_factory.mktemp("committed")
    config = GridConfig(
        "phihp",
        "pendulum",
        100,
        share=0.03,
        overrides=TINY,
        allow_dirty=True,
        runs=str(place / "runs"),
        results=str(place / "kept"),
    )
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        assert do(config).status is Status.DONE
    return config.files(Path())


def test_it_stands_beside_the_committed_one(committed: CellFiles) -> None:
    text = reproduce.beside(committed, committed)
    assert "committed | made again | difference" in text
    assert "0.0 |" in text
    assert "The settings are others" not in text


def test_settings_that_differ_are_named(committed: CellFiles, tmp_path: Path) -> None:
    other = CellFiles(replace(committed.cell, label="other"), committed.runs, tmp_path / "others")
    other.kept.mkdir(parents=True)
    for path in committed.kept.iterdir():
        (other.kept / path.name).write_bytes(path.read_bytes())
    config = other.kept / "config.yaml"
    config.write_text(config.read_text().replace("top_k: ", "top_k: 1"))
    text = reproduce.beside(committed, other)
    assert "planner.top_k" in text.partition("The settings are others by now: ")[2]


def test_a_run_that_is_not_there_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["reproduce.py", "acrobot", "--seed", "99", "--runs", str(tmp_path)]
    )
    with pytest.raises(SystemExit):
        reproduce.main()
    assert "acrobot-default-n2500-seed99: expected a committed run" in capsys.readouterr().err
