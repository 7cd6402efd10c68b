"""Reports: from folders of runs to the paper's tables and figures."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from test_recipes import RECIPES, recipe

from phihp_torchrl import get_task
from phihp_torchrl.evaluation import DEFAULT_SAMPLES
from phihp_torchrl.report import (
    BOUNDS,
    NOT_RUN,
    Number,
    ReportConfig,
    Results,
    Stat,
    Table,
    Trial,
    make_report,
    normalise,
    read_run,
    read_runs,
    samples_to_90,
    welch,
    write_trials,
)
from phihp_torchrl.report.aggregate import aggregates, profiles, score_matrix
from phihp_torchrl.report.claims import claims_section, fewer_samples, planning_improves
from phihp_torchrl.report.curves import mean_over_tasks, sample_curves, update_curves
from phihp_torchrl.report.efficiency import learning_points, sample_efficiency
from phihp_torchrl.report.overview import END, START, fill_page, overview
from phihp_torchrl.report.significance import welch_published
from phihp_torchrl.report.systems import (
    CEM_ORACLE,
    DD_CEM,
    PH_CEM,
    PHIHP,
    TD3,
    TD3_IM_DD,
    TD3_IM_PH,
    TD_MPC,
)
from phihp_torchrl.report.time_to_return import seconds_to

__all__ = ["recipe"]  # a fixture

COMMITTED = RECIPES.parent / "results" / "runs"
VERSION = version("phihp_torchrl")


def make_run(
    runs: Path,
    method: str = "phihp",
    task: str = "pendulum",
    seed: int = 0,
    samples: int = 1000,
    label: str = "default",
    acting: dict[str, list[float]] | None = None,
    curve: tuple[tuple[int, float], ...] = (),
    kind: str | None = "hybrid",
    error: float | None = None,
    ms: float = 5.0,
) -> Path:
    """A finished run's folder, as the benchmark keeps it."""
    acting = acting or {"planner": [-180.0, -190.0], "actor": [-181.0, -192.0]}
    name = f"{task}-{method}-{label}-n{samples}-seed{seed}"
    folder = runs / name
    folder.mkdir(parents=True)
    model = f"model: {{real_steps: {samples}, kind: {kind}}}\n" if kind else "model: null\n"
    (folder / "config.yaml").write_text(f"task: {task}\nmethod: {method}\nseed: {seed}\n{model}")
    session = {
        "commit": "0123456789abcdef",
        "dirty": False,
        "versions": {"phihp_torchrl": VERSION},
        "machine": {"cpus": 2, "memory_gib": 8.0, "gpus": 0},
    }
    metadata = {
        "sessions": [session],
        "seconds": {"model": 10.0, "policy": 20.0, "evaluate": 1.0},
        "real_steps": samples,
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    cell = {"method": method, "task": task, "seed": seed, "samples": samples, "label": label}
    (folder / "cell.json").write_text(json.dumps(cell))
    lines = ["phase,unit,real_steps,seconds,policy/updates,policy/real_return"]
    lines += [f"policy,{i},{x},{i},{10 * i},{y}" for i, (x, y) in enumerate(curve)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    evaluation = {
        way: {
            "returns": returns,
            "latency_ms_mean": ms,
            "latency_ms_p50": ms,
            "latency_ms_p99": 2 * ms,
        }
        for way, returns in acting.items()
    }
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    if error is not None:
        (folder / "prediction.json").write_text(json.dumps({"coverage_median": error}))
    return folder


def results(runs: Path) -> Results:
    found = read_runs(runs)
    assert not found.problems
    return Results(found.runs)


def report(tmp_path: Path, runs: Path | None = None, **changes):
    config = ReportConfig(
        runs=str(runs or tmp_path / "runs"),
        sensitivity=str(tmp_path / "sensitivity"),
        out=str(tmp_path / "report"),
        reps=50,
        overview=str(tmp_path / "overview.md"),
        page=str(tmp_path / "page.md"),
    )
    return make_report(replace(config, **changes))


def table(tmp_path: Path, name: str) -> list[dict[str, str]]:
    with (tmp_path / "report" / "tables" / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def text(made, title: str) -> str:
    return next(section.text for section in made.sections if section.title == title)


# --- reading -------------------------------------------------------------------------------------


def test_the_committed_runs_are_read_as_they_are() -> None:
    found = read_runs(COMMITTED, any_version=True)
    assert found.problems == ()
    assert len(found.runs) == len([path for path in COMMITTED.iterdir() if path.is_dir()])
    for run in found.runs:
        stored = json.loads((run.folder / "evaluation.json").read_text())
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

    made = report(tmp_path)
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
    assert len(report(tmp_path, any_version=True).problems) == 6


@pytest.mark.parametrize("exists", [True, False])
def test_an_empty_folder_makes_a_report_of_what_was_not_run(tmp_path: Path, exists: bool) -> None:
    runs = tmp_path / "runs"
    if exists:
        runs.mkdir()
    made = report(tmp_path)
    (problem,) = made.problems
    assert str(runs) in problem
    for name in ("main_return", "main_samples", "main_milliseconds"):
        for row in table(tmp_path, name):
            assert row["TD3 mean"] == row["PhIHP mean"] == NOT_RUN
    for line in text(made, "The paper's claims").splitlines():
        assert "not run" in line
    for path in (tmp_path / "report" / "tables").glob("*.csv"):
        assert ",," not in path.read_text().replace(",,\n", ",\n"), path
    assert "No runs yet." in (tmp_path / "overview.md").read_text()


# --- numbers -------------------------------------------------------------------------------------


def test_bounds_are_what_the_rewards_give_at_rest() -> None:
    for name, steps in (("pendulum", 200), ("pendulum-swingup", 500), ("acrobot-swingup", 500)):
        task = get_task(name)
        assert task.max_steps == steps
        worst = torch.zeros(task.system.state_dim)
        best = worst.clone()
        (worst if "pendulum" in name else best)[0] = math.pi
        action = torch.zeros(task.system.action_dim)
        for state, bound in zip((worst, best), BOUNDS[name], strict=True):
            reward = task.reward(state, action, state)
            assert steps * float(reward) == pytest.approx(bound, rel=1e-5, abs=1e-4)
    assert normalise("cartpole", 250.0) == 0.5
    with pytest.raises(ValueError, match="task: expected one of"):
        normalise("my-task", 0.0)


def test_samples_to_90_percent() -> None:
    assert samples_to_90([(100, 449.0), (200, 450.0), (300, 500.0)]) == 200
    assert samples_to_90([(100, -111.0), (200, -110.0), (300, -100.0)]) == 200
    assert samples_to_90([(100, -5.0)]) == 100


def test_a_policy_from_a_model_has_a_point_for_each_number_of_samples(tmp_path: Path) -> None:
    # The actor's evaluations during training all come after the last real step.
    curve = ((200, -900.0), (200, -300.0))
    make_run(tmp_path, samples=200, curve=curve)
    make_run(tmp_path, samples=1000, acting={"planner": [-120.0], "actor": [-150.0]})
    found = results(tmp_path)
    few, many = found.scores(PHIHP, "pendulum")
    assert learning_points(few) == [(200, -185.0)]
    assert learning_points(many) == [(1000, -120.0)]
    assert sample_efficiency(found, PHIHP, "pendulum") == (1000.0,)
    assert sample_curves(found, (PHIHP, TD3), "pendulum") == {
        "PhIHP": [((200, 1000), (-185.0, -120.0))]
    }
    # The planner's score counts for PhIHP, the actor's for TD3-im-ph: one run gives both.
    assert [score.mean for score in found.usual(TD3_IM_PH, "pendulum")] == [-150.0]
    assert update_curves(found, "pendulum") == {}
    assert len(update_curves(results(tmp_path), "cartpole")) == 0


def test_a_policy_from_real_steps_has_a_curve(tmp_path: Path) -> None:
    curve = ((1000, -900.0), (20000, -205.0), (30000, -199.0))
    make_run(tmp_path, "td3", samples=30000, curve=curve, acting={"actor": [-200.0]}, kind=None)
    found = results(tmp_path)
    (score,) = found.scores(TD3, "pendulum")
    assert score.run.kind is None
    # The last point is the final evaluation.
    assert learning_points(score) == [(1000, -900.0), (20000, -205.0), (30000, -200.0)]
    assert sample_efficiency(found, TD3, "pendulum") == (20000.0,)
    assert update_curves(found, "pendulum") == {
        "TD3": [([0.0, 10.0, 20.0], [-900.0, -205.0, -199.0])]
    }


def test_an_own_run_goes_before_the_part_of_another(tmp_path: Path) -> None:
    make_run(tmp_path, "phihp")
    make_run(tmp_path, "td3-im-ph", acting={"actor": [-1.0]})
    assert [score.mean for score in results(tmp_path).scores(TD3_IM_PH, "pendulum")] == [-1.0]


def test_a_cem_without_samples(tmp_path: Path) -> None:
    make_run(tmp_path, "cem-oracle", samples=0, kind="oracle", acting={"planner": [-200.0]})
    assert sample_efficiency(results(tmp_path), CEM_ORACLE, "pendulum") == (0.0,)


def test_the_mean_over_tasks_starts_where_all_have_a_return() -> None:
    steps, values = mean_over_tasks(
        {
            "cartpole": {0: [(0, 100.0), (50, 500.0)], 1: [(10, 300.0)]},
            "acrobot": {0: [(20, -500.0), (60, 0.0)]},
        }
    )
    assert steps.tolist() == [20, 50, 60]
    assert values.tolist() == pytest.approx([0.2, 0.4, 0.9])


def test_welch_against_numbers_worked_by_hand() -> None:
    pytest.importorskip("scipy")
    # Means 2 and 5, variances 1 and 4: t = -3 / sqrt(1/3 + 4/3).
    test = welch([1.0, 2.0, 3.0], [3.0, 5.0, 7.0])
    assert test is not None
    assert test.t == pytest.approx(-3 / math.sqrt(5 / 3))
    assert 0.05 < test.p < 0.15
    assert str(test) == "no difference"
    assert welch([1.0], [2.0, 3.0]) is None
    assert str(welch([500.0, 500.0], [400.0, 400.0])) == "higher"
    assert str(welch([500.0, 500.0], [500.0, 500.0])) == "no difference"
    published = welch_published("acrobot-swingup", "TD3")
    assert published is not None
    assert published.t == pytest.approx((371 - 119) / math.sqrt((52**2 + 71**2) / 10))
    assert welch_published("cartpole-swingup", "TD3") is None


def test_aggregates_and_profiles_against_numpy() -> None:
    pytest.importorskip("rliable")
    matrix = np.array([[0.1, 0.5], [0.2, 0.6], [0.3, 0.7], [0.4, 0.8]])
    one = aggregates({"x": matrix}, reps=200)["x"]
    assert one.values[0] == pytest.approx(np.median(matrix.mean(0)))
    assert one.values[2] == pytest.approx(matrix.mean())
    assert one.values[3] == pytest.approx(1 - matrix.mean())
    assert one.values[1] == pytest.approx(np.sort(matrix.ravel())[2:-2].mean())
    assert (one.low <= one.values).all()
    assert (one.values <= one.high).all()
    assert (one.low < one.high).all()
    # The same draws each time, and NumPy's own go on as if there had been none.
    np.random.seed(3)
    before = np.random.get_state()[1].tolist()
    again = aggregates({"y": matrix, "x": matrix}, reps=200)["x"]
    assert again.low.tolist() == one.low.tolist()
    assert np.random.get_state()[1].tolist() == before
    middle, low, high = profiles({"x": matrix}, np.array([0.0, 0.45, 0.9]), reps=50)["x"]
    assert middle.tolist() == [1.0, 0.5, 0.0]
    assert (low <= middle).all()
    assert (middle <= high).all()


def test_a_matrix_has_as_many_seeds_as_all_tasks_have(tmp_path: Path) -> None:
    for seed in range(3):
        make_run(tmp_path, task="cartpole", seed=seed, acting={"planner": [500.0], "actor": [0.0]})
    make_run(tmp_path, task="acrobot", acting={"planner": [-250.0], "actor": [0.0]})
    matrix = score_matrix(results(tmp_path), PHIHP, ("cartpole", "acrobot"))
    assert matrix is not None
    assert matrix.tolist() == [[1.0, 0.5]]
    assert score_matrix(results(tmp_path), PHIHP, ("cartpole", "pendulum")) is None


# --- claims --------------------------------------------------------------------------------------


def test_each_claim_gets_its_verdict(tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(tmp_path, seed=seed, acting={"planner": [9.0, 9.5], "actor": [1.0, 2.0]}, ms=4.0)
        curve = ((2000, -9.0), (9000, 9.0), (20000, 9.0))
        acting = {"planner": [9.0, 9.0]}
        make_run(tmp_path, "td-mpc", seed=seed, samples=20000, curve=curve, acting=acting, ms=20.0)
        make_run(tmp_path, "td3", seed=seed, samples=300, acting={"actor": [9.0, 11.0]})
        make_run(tmp_path, "ph-cem", seed=seed, samples=500, acting={"planner": [5.0]})
        make_run(tmp_path, "ph-cem", seed=seed, samples=5000, acting={"planner": [1.0]})
        make_run(tmp_path, "dd-cem", seed=seed, samples=500, acting={"planner": [4.0]})
    found = results(tmp_path)
    lines = claims_section(found).text.splitlines()
    assert "borne out here: pendulum 9.0 times fewer (1000 against 9000)" in lines[0]
    assert "not borne out here: pendulum 9.2 against 10.0 (not)" in lines[1]
    assert "borne out here: pendulum +7.8 ± " in lines[2]
    assert "borne out here: Ph-CEM on pendulum 5.0 against 4.0" in lines[3]
    assert "borne out here: pendulum 5.0 times (4.0 ms against 20.0)" in lines[4]
    # Another task on which it is not.
    make_run(tmp_path, task="acrobot", acting={"planner": [1.0, 3.0], "actor": [1.0, 3.0]})
    assert "in 1 of 2 comparisons" in claims_section(results(tmp_path)).text.splitlines()[2]
    assert [finding.borne_out for finding in planning_improves(results(tmp_path))] == [True, False]
    assert [finding.what for finding in fewer_samples(found)] == ["pendulum"]


def test_hybrid_and_data_driven_are_compared_at_equal_samples_alone(tmp_path: Path) -> None:
    make_run(tmp_path, "td3-im-ph", samples=1000, acting={"actor": [-1.0]})
    make_run(tmp_path, "td3-im-dd", samples=500, acting={"actor": [-2.0]}, kind="data_driven")
    found = results(tmp_path)
    assert found.has_run(TD3_IM_DD, "pendulum")
    assert not found.has_run(DD_CEM, "pendulum")
    assert not found.has_run(PH_CEM, "pendulum")
    assert not found.has_run(TD_MPC, "pendulum")
    assert "not run" in claims_section(found).text.splitlines()[3]


# --- writing -------------------------------------------------------------------------------------


def test_the_default_presets_samples_go_before_more(tmp_path: Path) -> None:
    for samples, earned in ((200, -300.0), (1000, -200.0), (2000, -100.0)):
        make_run(tmp_path, samples=samples, acting={"actor": [earned], "planner": [earned]})
    make_run(tmp_path, method="td3", samples=30_000, kind=None, acting={"actor": [-150.0]})
    found = results(tmp_path)
    assert [score.mean for score in found.usual(PHIHP, "pendulum")] == [-200.0]
    assert [score.mean for score in found.usual(TD3, "pendulum")] == [-150.0]


def test_the_default_preset_takes_the_samples_that_reports_think() -> None:
    for task, samples in DEFAULT_SAMPLES.items():
        path = RECIPES / "config" / "task" / f"{task}.yaml"
        preset = yaml.safe_load(path.read_text())["presets"]["default"]
        assert preset["model"]["real_steps"] == samples, task


def test_seconds_to_a_return(tmp_path: Path) -> None:
    """During training by the clock of the curve, at the end by all of it, else never."""
    curve = ((1000, -900.0), (1000, -300.0), (1000, -150.0))
    run = read_run(make_run(tmp_path, curve=curve))
    assert seconds_to(run, -300.0) == 1.0
    assert seconds_to(run, -200.0) == 2.0
    last = read_run(make_run(tmp_path, seed=1, curve=curve[:1]))
    assert seconds_to(last, -200.0) == 30.0
    assert seconds_to(last, -100.0) is None


def test_time_to_the_published_return_against_published_updates(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    make_run(runs, curve=((1000, -900.0), (1000, -200.0)))
    make_run(runs, seed=1, curve=((1000, -900.0),))
    make_run(runs, task="cartpole", acting={"planner": [9.0, 9.0], "actor": [8.0, 8.0]})
    rows = [["fused step, compiled", "2.0", "1.00"]]
    timed = tmp_path / "benchmarks.json"
    timed.write_text(json.dumps({"A TD3 update of 64 transitions": {"rows": rows}}))
    report(tmp_path, runs, benchmarks=str(timed))
    pendulum, cartpole = table(tmp_path, "time_to_return")
    assert float(pendulum["s to it mean"]) == pytest.approx((1.0 + 30.0) / 2)
    assert float(pendulum["published updates, s"]) == pytest.approx(1000.0)
    assert float(pendulum["times our s to it"]) == pytest.approx(1000.0 / 15.5)
    assert cartpole["reached by"] == "0 of 1"
    assert cartpole["times our s to it"] == NOT_RUN
    report(tmp_path, runs, benchmarks=str(tmp_path / "none.json"))
    assert table(tmp_path, "time_to_return")[0]["published updates, s"] == NOT_RUN


def test_the_whole_report(tmp_path: Path) -> None:
    pytest.importorskip("rliable")
    runs = tmp_path / "runs"
    for seed in (0, 1):
        for task in ("pendulum", "pendulum-swingup", "cartpole", "cartpole-swingup", "acrobot",
                     "acrobot-swingup"):  # fmt: skip
            make_run(runs, task=task, seed=seed, error=0.01, curve=((1000, -200.0 - seed),))
            make_run(runs, "dd-cem", task, seed, acting={"planner": [-400.0 - seed]},
                     kind="data_driven", error=0.1)  # fmt: skip
    make_run(runs, label="paper", seed=3)
    trials = [Trial("pendulum", 0, "planning_horizon", h, -180.0 - h, 1.0, 5, h) for h in (1, 4)]
    write_trials(tmp_path / "sensitivity" / "pendulum.json", trials)
    (tmp_path / "sensitivity" / "torn.json").write_text("[{")
    (tmp_path / "page.md").write_text(f"# Page\n\n{START}\nold\n{END}\n\nThe end.\n")
    made = report(tmp_path)
    (problem,) = made.problems
    assert "torn.json" in problem

    page = (tmp_path / "report" / "README.md").read_text()
    for section in made.sections:
        assert f"## {section.title}\n" in page
        for made_table in section.tables.values():
            assert table(tmp_path, made_table.name)
        for picture in section.pictures:
            for suffix in ("svg", "png"):
                assert (tmp_path / "report/figures" / f"{picture.name}.{suffix}").stat().st_size
            assert f"(figures/{picture.name}.svg)" in page
    # Beside the published numbers, and of the one label alone.
    assert "| −185.0 ± 0.0 (2) | −263 ± 144 | not run | −276 ± 301 |" in page
    rows = {row["task, model"]: row for row in table(tmp_path, "generalization")}
    assert float(rows["pendulum, data-driven"]["error mean"]) == 0.1
    assert float(rows["pendulum, hybrid"]["return mean"]) == -185.0
    sweep = [(row["setting"], row["value"]) for row in table(tmp_path, "sensitivity")]
    assert sweep == [("H", "1"), ("H", "4")]
    over = {row["system"]: row for row in table(tmp_path, "aggregates_over_tasks")}
    assert over["TD-MPC"]["mean"] == NOT_RUN
    assert 0 < float(over["dd-CEM"]["IQM"]) < float(over["PhIHP"]["IQM"]) < 1
    assert "## paper" in (tmp_path / "overview.md").read_text()
    filled = (tmp_path / "page.md").read_text()
    assert "old" not in filled
    assert "| pendulum | 2 | 1000 | −185.0 ± 0.0 | −186.5 ± 0.0 |" in filled
    assert filled.endswith("\n\nThe end.\n")

    # The same runs make the same files.
    def files() -> dict[str, bytes]:
        kept = sorted(p for p in (tmp_path / "report").rglob("*") if p.is_file())
        return {str(path): path.read_bytes() for path in kept}

    before = files()
    shutil.rmtree(tmp_path / "report")
    report(tmp_path)
    assert files() == before


def test_without_the_extra_the_rest_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_run(tmp_path / "runs")
    monkeypatch.setitem(__import__("sys").modules, "rliable", None)
    made = report(tmp_path)
    assert "phihp_torchrl[report]" in text(made, "Performance over runs")
    assert any("rliable" in problem for problem in made.problems)
    assert table(tmp_path, "main_return")[0]["PhIHP mean"] == "-185.0"


def test_a_table_for_people_and_for_programs() -> None:
    rows = [["a", Stat((1.0, 3.0)), Number(2.0)], ["b", Stat(()), Number(None)], ["c", "–", "–"]]
    made = Table("t", ["x", "y", "z"], rows)
    assert made.markdown().splitlines()[2:] == [
        "| a | 2.0 ± 1.4 (2) | 2 |",
        "| b | not run | not run |",
        "| c | – | – |",
    ]
    assert made.csv().splitlines() == [
        "x,y mean,y std,y seeds,z",
        f"a,2.0,{math.sqrt(2)},2,2.0",
        "b,not run,not run,not run,not run",
        "c,–,–,–,–",
    ]


def test_a_page_without_markers_is_left_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    make_run(tmp_path / "runs")
    runs = read_runs(tmp_path / "runs").runs
    assert not fill_page(page, runs)
    page.write_text(f"{END} {START}")
    assert not fill_page(page, runs)
    assert page.read_text() == f"{END} {START}"
    assert "### Time" in overview(runs)


def test_the_recipe_makes_the_report_and_logs_its_figures(
    recipe: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rliable")
    pytest.importorskip("tensorboard")
    for seed in (0, 1):
        make_run(tmp_path / "results" / "runs", seed=seed)
    recipe("report", "reps=20", "logger=tensorboard")
    assert "wrote results/report/README.md" in capsys.readouterr().out
    with (tmp_path / "results/report/tables/main_return.csv").open() as file:
        row = next(csv.DictReader(file))
    assert (row["PhIHP mean"], row["PhIHP seeds"]) == ("-185.0", "2")
    overview_page = (tmp_path / "results/README.md").read_text()
    assert "### Returns with fewer real samples" in overview_page
    assert "2 evaluation episodes each" in overview_page
    assert list((tmp_path / "outputs" / "report").rglob("*tfevents*"))
    with pytest.raises(SystemExit, match=r"^error: reps: expected a positive"):
        recipe("report", "reps=0")


@pytest.mark.slow
def test_sensitivity_is_swept_and_reported(
    recipe: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = RECIPES.parent / "results" / "agents" / "pendulum"
    recipe(
        "sensitivity", f"agent={agent}", "episodes=1", "latency_actions=2",
        "planning_horizon=[1,2]", "replan_every=[1,99]", "num_policy_candidates=[0]",
        "num_random_candidates=[0]",
    )  # fmt: skip
    (path,) = (tmp_path / "results" / "sensitivity").iterdir()
    trials = json.loads(path.read_text())
    swept = [(trial["setting"], trial["value"]) for trial in trials]
    assert swept == [
        ("planning_horizon", 1),
        ("planning_horizon", 2),
        ("replan_every", 1),
        ("num_policy_candidates", 0),
        ("num_random_candidates", 0),
    ]
    assert all(trial["milliseconds"] > 0 for trial in trials)
    with pytest.raises(SystemExit, match=r"^error: agent: expected the directory"):
        recipe("sensitivity")
    with pytest.raises(SystemExit, match=r"^error: episodes: expected a positive"):
        recipe("sensitivity", f"agent={agent}", "episodes=0")
