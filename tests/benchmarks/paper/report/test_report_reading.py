"""Runs as a report reads them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from grid_cells import ROOT
from kept_runs import VERSION, make, make_run, table, text

import six_tasks
from phihp_torchrl import load_config
from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation import TARGETS
from report import (
    NOT_RUN,
    build,
    read_run,
    read_runs,
)
from report.action_times import read_turns
from report.claims import claims_section
from report.main_table import main_table
from report.planned import read_planned
from report.planner_and_actor import acting_section
from report.results import Results

COMMITTED = [ROOT / "results" / name for name in ("runs", "runs-0.1.0")]


@pytest.mark.parametrize("place", COMMITTED, ids=lambda place: place.name)
def test_the_committed_runs_are_read_as_they_are(place: Path) -> None:
    found = read_runs(place, any_version=True)
    assert found.problems == ()
    assert len(found.runs) == len([path for path in place.iterdir() if path.is_dir()]) > 0
    for run in found.runs:
        stored = json.loads((run.folder / "evaluation.json").read_text())
        stored.pop("baselines", None)
        assert run.acting.keys() == stored.keys()
        for way, part in stored.items():
            assert run.acting[way].mean == pytest.approx(part["return_mean"])
            assert run.acting[way].latency["p99"] == part["latency_ms_p99"]
        assert run.folder.name.startswith(f"{run.task}-")
        assert run.folder.name.endswith(f"-seed{run.seed}")
        assert run.label in ("default", "paper")


@pytest.mark.parametrize(
    ("name", "method", "label"),
    [
        ("pendulum-default-n1000-seed0", "phihp", "default"),
        ("pendulum-no-q-n1000-seed0", "phihp", "no-q"),
        ("pendulum-td3-paper-seed12", "td3", "paper"),
        ("pendulum-cem-oracle-seed0", "cem-oracle", "default"),
    ],
)
def test_a_run_without_a_cell_has_its_label_in_its_name(
    tmp_path: Path, name: str, method: str, label: str
) -> None:
    folder = make_run(tmp_path, method)
    (folder / "cell.json").unlink()
    run = read_run(folder.rename(tmp_path / name))
    assert (run.method, run.label, run.samples) == (method, label, 1000)


def test_every_unfit_folder_is_named_and_the_rest_is_reported(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    make_run(runs, seed=0)
    half = make_run(runs, seed=1)
    (half / "evaluation.json").unlink()
    nan = make_run(runs, seed=2, acting={"planner": [-180.0, math.nan], "actor": [-1.0, -2.0]})
    old = make_run(runs, seed=3)
    metadata = (old / "metadata.json").read_text().replace(VERSION, "9.9.9")
    (old / "metadata.json").write_text(metadata)
    torn = make_run(runs, seed=4)
    (torn / "evaluation.json").write_text('{"planner": {"returns": [1.0, ')
    empty = make_run(runs, seed=5)
    (empty / "config.yaml").write_text("")
    bare = make_run(runs, seed=6)
    (bare / "metadata.json").write_text("{}")
    odd = make_run(runs, seed=7)
    (odd / "curve.csv").write_text("a,b\n1,2\n")
    (runs / "notes.txt").write_text("no folder")

    made = make(tmp_path)
    assert len(made.problems) == 7
    said = dict(zip((half, nan, old, torn, empty, bare, odd), made.problems, strict=True))
    for folder, problem in said.items():
        assert str(folder) in problem
    assert "evaluation.json is missing" in said[half]
    assert "1 of 2 are not" in said[nan]
    assert "9.9.9" in said[old]
    assert VERSION in said[old]
    assert "'sessions'" in said[bare]
    page = (tmp_path / "report" / "README.md").read_text()
    assert all(problem in page for problem in made.problems)
    assert table(tmp_path, "main_return")[0]["PhIHP seeds"] == "1"
    assert len(make(tmp_path, any_version=True).problems) == 6


def test_where_no_folder_can_be_read_the_old_report_stays(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "runs")
    make(tmp_path)
    before = (tmp_path / "report" / "README.md").read_text()
    (folder / "evaluation.json").unlink()
    with pytest.raises(ConfigError, match=r"runs: .*evaluation.json is missing"):
        make(tmp_path)
    assert (tmp_path / "report" / "README.md").read_text() == before


def test_a_part_that_fails_costs_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_run(tmp_path / "runs")
    monkeypatch.setattr(build, "significance", lambda results: 1 / 0)
    (problem,) = make(tmp_path).problems
    assert "PhIHP against each baseline: not made: ZeroDivisionError" in problem
    assert table(tmp_path, "main_return")


@pytest.mark.parametrize("exists", [True, False])
def test_an_empty_folder_makes_a_report_of_what_was_not_run(tmp_path: Path, exists: bool) -> None:
    runs = tmp_path / "runs"
    if exists:
        runs.mkdir()
    made = make(tmp_path)
    (problem,) = made.problems
    assert str(runs) in problem
    numbers = {"main_return": " mean", "main_samples": " to", "main_milliseconds": " mean"}
    for name, number in numbers.items():
        for row in table(tmp_path, name):
            assert row[f"TD3{number}"] == row[f"PhIHP{number}"] == NOT_RUN
    for line in text(made, "The paper's claims").splitlines():
        assert "not run" in line
    for path in (tmp_path / "report" / "tables").glob("*.csv"):
        assert ",," not in path.read_text().replace(",,\n", ",\n"), path
    assert "No runs yet." in (tmp_path / "overview.md").read_text()


def test_the_committed_report_is_that_of_the_committed_runs() -> None:
    place = ROOT / "results" / "runs"
    found = read_runs(place, any_version=True).runs
    chosen = [run for run in found if run.label == "default"]
    results = Results(chosen, read_planned(place).of("default"))
    sections = (
        main_table(results),
        claims_section(results, read_turns(ROOT / "results" / "latency")[0]),
        acting_section(results.runs, results.planned),
    )
    for section in sections:
        assert section.tables
        for made in section.tables.values():
            kept = ROOT / "results" / "report" / "tables" / f"{made.name}.csv"
            assert kept.read_text() == made.csv(), f"{kept.name}: run `make report`"


def test_the_table_of_the_readme_is_that_of_the_committed_runs() -> None:
    found = read_runs(ROOT / "results" / "runs", any_version=True)
    kept = (ROOT / "README.md").read_text().split(six_tasks.START)[1].split(six_tasks.END)[0]
    assert kept.strip() == six_tasks.brief(found.runs).strip(), "run `make report`"


@pytest.mark.parametrize("task", TARGETS)
def test_the_committed_times_of_an_action_are_of_the_default_search(task: str) -> None:
    kept = json.loads((ROOT / "results" / "latency" / f"{task}.json").read_text())
    assert kept["search"] == load_config(task)["planner"], "run benchmarks/paper/latency.py"
