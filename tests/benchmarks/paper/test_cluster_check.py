"""A grid on a Ray cluster that loses a node."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from kept_runs import make_run

import cluster_check
from measures import CurvePoint, write_curve


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_no_cell_is_lost_or_done_twice_when_a_node_dies(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    pytest.importorskip("rliable")
    assert cluster_check.check(tmp_path / "check", seeds=3) == []


def test_the_check_sees_what_was_done_twice(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    kept = tmp_path / "results" / "a"
    kept.mkdir(parents=True)
    (tmp_path / "runs" / "a.log").write_text("INFO: started\nINFO: resumed\nINFO: finished\n")
    (kept / "metrics.csv").write_text("phase,unit\nmodel,0\nmodel,1\n")
    (kept / "evaluation.json").write_text("{}")
    assert cluster_check.twice_done(tmp_path) == []
    assert cluster_check.interrupted(tmp_path) == ["a"]
    assert cluster_check.done(tmp_path) == ["a"]
    (tmp_path / "runs" / "a.log").write_text("INFO: finished\nINFO: started\nINFO: finished\n")
    (kept / "metrics.csv").write_text("phase,unit\nmodel,0\nmodel,0\nmodel,1\n")
    assert cluster_check.twice_done(tmp_path) == [
        "a finished 2 times",
        "a has units [0, 0, 1]",
    ]


def test_times_apart_two_reports_are_the_same(tmp_path: Path) -> None:
    pytest.importorskip("rliable")
    for name, ms, earned in (("a", 1.0, -5.0), ("b", 2.0, -5.0), ("c", 1.0, -6.0)):
        acting = {"planner": [earned, -7.0], "actor": [-8.0, -9.0]}
        folder = make_run(tmp_path / name / "results", ms=ms, acting=acting)
        # A return that the report gives the seconds to.
        write_curve(folder / "curve.csv", [CurvePoint("policy", 1000, ms, "actor", -150.0)])
    first, second, third = (
        cluster_check.report_files(tmp_path / name, tmp_path / "compared") for name in "abc"
    )
    assert first == second
    differing = {name for name in first if first[name] != third[name]}
    assert {"overview.md", "report/README.md", "report/tables/main_return.csv"} <= differing
    kept = next((tmp_path / "compared" / "results").iterdir())
    assert json.loads((kept / "metadata.json").read_text())["seconds"]["policy"] == 0.0
