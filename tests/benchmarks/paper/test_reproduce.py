"""One published number, made again."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from brief import shorten
from grid_cells import TINY, do

import reproduce
from grid import CellFiles, CellState, GridConfig, Status
from phihp_torchrl.config import ConfigError


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


def asked_for(
    monkeypatch: pytest.MonkeyPatch, kept: Path, *words: str, error: Exception | None = None
) -> GridConfig:
    """The cell that the script would run."""
    configs: list[GridConfig] = []

    def work(config: GridConfig, root: Path) -> CellState:
        configs.append(config)
        if error is not None:
            raise error
        return CellState(Status.FAILED, "not run")

    monkeypatch.setattr(reproduce, "work", work)
    monkeypatch.setattr(sys, "argv", ["reproduce.py", *words, "--runs", str(kept)])
    with pytest.raises(SystemExit):
        reproduce.main()
    return configs[0]


def keep(kept: Path, name: str, **cell: bool) -> None:
    (kept / name).mkdir(parents=True)
    (kept / name / "evaluation.json").write_text("{}")
    if cell:
        (kept / name / "cell.json").write_text(json.dumps(cell))


def test_a_cell_has_the_settings_that_its_grid_gave_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep(tmp_path, "acrobot-td3-default-seed0")
    words = ("acrobot", "--method", "td3", "--seed", "0", "--overrides", "compile=false")
    config = asked_for(monkeypatch, tmp_path, *words)
    assert "td3.real_steps=300000" in config.words()
    assert "compile=false" in config.words()
    assert not config.proof


def test_a_cell_of_the_proof_plays_the_episodes_of_the_proof(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, proof in ((100, True), (101, False)):
        keep(tmp_path, f"acrobot-default-n2500-seed{seed}", proof=proof)
        config = asked_for(monkeypatch, tmp_path, "acrobot", "--seed", str(seed))
        assert (config.proof, config.allow_dirty) == (proof, not proof)
    dirty = ConfigError("allow_dirty", "expected a tree without uncommitted changes.")
    asked_for(monkeypatch, tmp_path, "acrobot", "--seed", "100", error=dirty)
    assert "acrobot-default-n2500-seed100: allow_dirty: expected" in capsys.readouterr().err
