"""The stages of the last proof."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from grid_cells import YAML

import proof
from grid.sweep import swept_cells


def run(monkeypatch: pytest.MonkeyPatch, *words: str, codes: tuple[int, ...] = ()) -> list[Any]:
    """Run the script; returns the command and the folder of each grid that it would start."""
    started: list[Any] = []
    answers = iter(codes)

    def call(command: list[str], *, cwd: Path, env: dict[str, str]) -> int:
        started.append((command[1:], cwd, env["PYTHONPATH"]))
        return next(answers, 0)

    monkeypatch.setattr(proof.subprocess, "call", call)
    monkeypatch.setattr("sys.argv", ["proof.py", *words])
    proof.main()
    return started


@pytest.mark.parametrize("stage", proof.STAGES)
def test_each_stage_is_a_grid_of_the_proof(stage: str, tmp_path: Path) -> None:
    base = {key: value for key, value in YAML.items() if key not in ("defaults", "hydra")}
    cells = swept_cells(base, ["proof=true", *proof.STAGES[stage]], tmp_path)
    assert len({files.cell.name for files in cells}) == len(cells) >= 5
    assert {files.cell.seed for files in cells} <= {*range(150, 160)}


def test_the_twin_is_run_wherever_phihp_is(tmp_path: Path) -> None:
    base = {key: value for key, value in YAML.items() if key not in ("defaults", "hydra")}
    numbers: dict[str, set[tuple[str, int | None]]] = {"phihp": set(), "dd-phihp": set()}
    for words in proof.STAGES.values():
        for files in swept_cells(base, words, tmp_path):
            if files.cell.label == "default" and files.cell.method in numbers:
                numbers[files.cell.method].add((files.cell.task, files.cell.samples))
    variant = {(task, n) for task, n in numbers["phihp"] if task == "cartpole-swingup-published"}
    assert numbers["phihp"] - variant == numbers["dd-phihp"]


def test_stages_and_settings_are_told_apart(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (command, place, path), *others = run(monkeypatch, "cem", "td3", "jobs=2", "clone=../frozen")
    clone = tmp_path / "../frozen"
    assert command[0] == str(clone / "benchmarks" / "paper" / "run_grid.py")
    assert command[1:] == [
        "proof=true",
        *proof.STAGES["cem"],
        "jobs=2",
        f"results={tmp_path / 'results/runs'}",
    ]
    assert (place, path) == (clone, str(clone))
    assert [other[0][1:5] for other in others] == [["proof=true", *proof.STAGES["td3"]][:4]]
    assert run(monkeypatch, "td3", "results=there")[0][0][-1] == "results=there"


def test_a_failed_cell_stops_no_other_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="of the stages cem"):
        run(monkeypatch, "cem", "td3", codes=(1, 0))
    assert len(run(monkeypatch)) == len(proof.STAGES)


def test_an_unknown_stage_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="got 'tdmpc'"):
        run(monkeypatch, "phihp", "tdmpc")
