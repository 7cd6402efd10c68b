"""The protocol of the last proof: whose episodes, and whose code."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from grid_cells import TINY, do

from grid import GridConfig, Status, committed
from phihp_torchrl import origin
from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation import PROOF_SEED
from phihp_torchrl.trainers import RunDirectory
from report import read_run

WHO = ("-c", "user.name=a", "-c", "user.email=a@b.c")


def git(place: Path, *words: str) -> None:
    subprocess.run(["git", *WHO, *words], cwd=place, check=True)


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A clone with one commit, that this process seems to run."""
    place = tmp_path / "clone"
    for name in ("phihp_torchrl/origin.py", "benchmarks/paper/run_grid.py"):
        (place / name).parent.mkdir(parents=True)
        (place / name).write_text("1\n")
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        git(place, *words)
    monkeypatch.setattr(origin, "__file__", str(place / "phihp_torchrl" / "origin.py"))
    monkeypatch.setattr(committed, "CLONE", place)
    committed.check_committed()
    return place


@pytest.fixture
def proof(config: GridConfig, clone: Path) -> GridConfig:
    """A cell of the last proof."""
    return replace(config, seed=100, allow_dirty=False, proof=True)


@pytest.mark.parametrize(
    "words",
    ["evaluate.first_seed=2000100", "++evaluate.first_seed=1000000", "evaluate={first_seed:7}"],
)
@pytest.mark.parametrize("key", ["overrides", "method_overrides"])
def test_nothing_but_proof_chooses_the_episodes(config: GridConfig, key: str, words: str) -> None:
    settings = {"overrides": (words,), "method_overrides": {"phihp": (words,)}}[key]
    proof = {"proof": True, "seed": 100, "allow_dirty": False}
    for changes in ({}, proof):
        with pytest.raises(ConfigError, match=f"^{key}: expected no .* use proof=true"):
            replace(config, **{**changes, key: settings})


def test_episodes_that_were_chosen_unseen_end_the_cell(config: GridConfig) -> None:
    there = "evaluate.first_seed"
    object.__setattr__(
        config, "overrides", (*TINY, f"{there}={PROOF_SEED}")
    )  # past checks of words
    state = do(config)
    assert state.status is Status.FAILED
    assert f"{there}: expected 1000000 with proof=false, got {PROOF_SEED}" in state.detail


def test_a_proof_plays_the_episodes_that_are_kept_for_it(
    config: GridConfig, proof: GridConfig
) -> None:
    assert f"evaluate.first_seed={PROOF_SEED}" in proof.words()
    assert not any(word.startswith("evaluate.first_seed") for word in config.words())
    with pytest.raises(ConfigError, match=r"allow_dirty: expected false with proof=true"):
        replace(proof, allow_dirty=True)
    with pytest.raises(ConfigError, match=r"seed: expected 100 or more with proof=true"):
        replace(proof, seed=99)


def test_no_idle_core_has_a_say_in_a_proof(config: GridConfig, proof: GridConfig) -> None:
    assert "evaluate.packaged=false" in proof.words()
    assert not any("packaged" in word for word in config.words())
    state = do(replace(proof, overrides=(*TINY, "evaluate.packaged=auto")))
    assert state.status is Status.FAILED
    assert "evaluate.packaged: expected true or false with proof=true, got auto" in state.detail


def test_a_proof_is_of_one_commit(proof: GridConfig, clone: Path) -> None:
    files = proof.files(Path())
    assert do(proof).status is Status.DONE
    assert json.loads((files.kept / "cell.json").read_text())["proof"] is True
    settings = yaml.safe_load((files.kept / "config.yaml").read_text())
    assert settings["evaluate"]["packaged"] is False
    assert read_run(files.kept).seed == 100  # a report reads it
    first = str(origin.source_commit())
    git(clone, "commit", "-q", "--allow-empty", "-m", "second")
    with pytest.raises(ConfigError, match=f"HEAD at {first}"):
        do(proof)
    origin._first_commit.cache_clear()  # as in another process
    second = str(origin.source_commit())
    with pytest.raises(ConfigError, match=f"commit {second} alone, got a session of {first[:7]}"):
        do(proof)
    for path in files.kept.iterdir():  # it was cut off
        path.unlink()
    with pytest.raises(ConfigError, match=f"^{files.run}: .* {second} alone, .* {first[:7]}"):
        do(proof)
    assert len(RunDirectory(files.run).read_metadata()["sessions"]) == 1
    assert do(replace(proof, results=str(clone), runs=str(clone))).status is Status.DONE


def test_a_proof_whose_code_changed_as_it_began_is_not_kept(
    proof: GridConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(origin, "has_changes", lambda: True)  # after the grid has looked
    state = do(proof)
    assert state.status is Status.FAILED
    assert f"got a session of {str(origin.source_commit())[:7]}+" in state.detail
    assert not proof.files(Path()).evaluation.exists()


def test_code_that_is_not_that_of_the_commit_is_refused(
    config: GridConfig, clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = replace(config, allow_dirty=False)

    def refused(words: str) -> None:
        with pytest.raises(ConfigError, match=f"^allow_dirty: expected {words}"):
            do(cell)
        assert not cell.files(Path()).run.exists()

    new = clone / "benchmarks" / "paper" / "deep" / "new.py"
    new.parent.mkdir()
    new.write_text("")
    refused("no code that git does not know, .* got benchmarks/paper/deep/new.py")
    new.unlink()
    script = clone / "benchmarks" / "paper" / "run_grid.py"
    script.write_text("2\n")
    refused("a tree without uncommitted changes")
    git(clone, "checkout", "-q", ".")
    committed.check_committed()
    monkeypatch.setattr(origin, "ask_git", lambda *_: None)
    refused("git to say whether the tree has changes")
    monkeypatch.setattr(committed, "CLONE", clone.parent)
    refused(f"{clone.parent}/phihp_torchrl as the package .* got {clone}/phihp_torchrl")
