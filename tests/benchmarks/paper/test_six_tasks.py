"""The table of the default on the six tasks: whose runs count, who plays, and how long it took."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from grid_cells import ROOT
from kept_runs import make_run

import six_tasks
from measures import agent_in
from report.runs import read_run, read_runs


def test_reporting_seeds_of_the_default_alone_count(tmp_path):
    for seed in (0, 99, 100, 103):
        make_run(tmp_path, seed=seed)
    make_run(tmp_path, seed=104, label="wide")
    make_run(tmp_path, seed=105, method="td3-im-ph")
    make_run(tmp_path, seed=106, samples=200)
    found = read_runs(tmp_path).runs
    assert [run.seed for run in six_tasks.ours(found, "pendulum")] == [100, 103]
    assert six_tasks.ours(found, "acrobot") == []


def test_intervals_are_over_seeds(tmp_path):
    for seed, mean in ((100, -180.0), (101, -190.0)):
        make_run(tmp_path, seed=seed, acting={"actor": [mean] * 50})
    cells = six_tasks.row("pendulum", read_runs(tmp_path).runs)
    assert cells[1:4] == ["2", "1,000", "-185.0 [-248.5, -121.5]"]
    assert cells[3] == cells[5], "where calibration let the actor act, the agent is the actor"
    assert six_tasks.spread([1.0], 1) == "1.0"


def test_chatter_is_that_of_who_plays(tmp_path):
    folder = make_run(tmp_path, seed=100)
    evaluation = json.loads((folder / "evaluation.json").read_text())
    for name, value in (("planner", 0.25), ("actor", 0.5)):
        evaluation[name]["chatter"] = value
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    run = read_runs(tmp_path).runs[0]
    assert [six_tasks.chatter(run, name) for name in ("planner", "actor")] == [0.25, 0.5]


def test_time_to_the_published_return_is_that_of_the_first_actor_to_earn_it(tmp_path):
    curve = ((1000, -900.0), (1000, -262.0), (1000, -300.0))
    final = {"planner": [-290.0], "actor": [-310.0]}
    make_run(tmp_path, seed=100, curve=curve, acting=final)
    run = read_runs(tmp_path).runs[0]
    assert six_tasks.times([run], -263.0) == "1"
    make_run(tmp_path, seed=101, curve=curve[:1], acting=final)
    assert six_tasks.times(read_runs(tmp_path).runs, -263.0) == "– (1 of 2)", "half did not"
    make_run(tmp_path, seed=102, curve=curve, acting=final)
    runs = read_runs(tmp_path).runs
    assert six_tasks.times(runs, -263.0) == "1 (2 of 3)", "the median, not a mean of those who did"
    with pytest.raises(ValueError, match="pendulum: expected runs of one configuration"):
        six_tasks.page([run, replace(runs[1], configuration="another")])
    page = six_tasks.page([run])
    assert "Training seeds 100." in page
    assert "Not run yet: pendulum-swingup" in page
    first = six_tasks.brief([run]).splitlines()[2]
    assert first.startswith("| pendulum | 1 | ")
    assert first.endswith("| -263 ± 144 | 2,000 |")


def test_aims_are_the_returns_of_the_runs_that_their_file_names():
    source = json.loads((ROOT / "benchmarks" / "paper" / "aims.json").read_text())
    assert "results/runs-0.1.0/<task>-default-n<real_steps>-seed<0-4>" in source["source"]
    kept = ROOT / "results" / "runs-0.1.0"
    for task, aim in source["tasks"].items():
        names = (f"{task}-default-n{aim['real_steps']}-seed{seed}" for seed in range(5))
        runs = [read_run(kept / name, any_version=True) for name in names]
        mean = sum(run.acting[agent_in(run.acting)].mean for run in runs) / len(runs)
        assert round(mean, 1) == six_tasks.AIMS[task]
