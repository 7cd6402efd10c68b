"""What was planned, and what a report says where it is not there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from kept_runs import make, make_run, table, text

from grid.cell import Cell, CellFiles
from grid.keep import keep_failure, keep_names
from measures import holm
from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation import PROOF_SEED
from report import Results, read_runs
from report.claims import claims_section, hybrid_earns_more
from report.planned import read_planned, samples_of
from report.planned_section import planned_section


def make_planned(runs: Path, *cells: Cell) -> None:
    """Runs of these cells, in folders with their names, where nothing of them is there."""
    for i, cell in enumerate(cells):
        means = {"planner": [9.0 + 0.1 * i], "actor": [1.0 - 0.3 * i**2]}
        samples = cell.samples or 1000
        folder = make_run(runs, cell.method, cell.task, cell.seed, samples, acting=means)
        folder.rename(runs / cell.name)


def plan(runs: Path, *cells: Cell) -> None:
    keep_names([CellFiles(cell, runs.parent / "full", runs) for cell in cells])


def fail(runs: Path, cell: Cell, error: str) -> None:
    record = {"error": error, "when": "now", "commit": None}
    keep_failure(CellFiles(cell, runs.parent / "full", runs), record)


def seeds(method: str = "phihp", task: str = "pendulum", count: int = 3) -> list[Cell]:
    return [Cell(method, task, 100 + seed, 1000) for seed in range(count)]


def rows(runs: Path) -> dict[str, list[str]]:
    """The claims' comparisons by name."""
    found = Results(read_runs(runs).runs, read_planned(runs))
    table = claims_section(found).tables["Comparisons"]
    return {str(row[0]): [str(cell) for cell in row[1:]] for row in table.rows}


def test_cells_that_failed_or_are_missing_are_counted_with_their_reason(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    cells = seeds(count=10)
    make_planned(runs, *cells[:7])
    plan(runs, *cells, *seeds("td3", count=2), Cell("phihp", "acrobot", 100, 5, "other"))
    for cell in cells[7:9]:
        fail(runs, cell, "ValueError: a | b")
    made = make(tmp_path)
    found = {row["task, method, real samples"]: row for row in table(tmp_path, "planned")}
    assert {name: row["done of planned"] for name, row in found.items()} == {
        "pendulum, phihp, 1000": "7 of 10; 2 failed: ValueError: a / b, 1 missing",
        "pendulum, td3, 1000": "0 of 2; 2 missing",
        "acrobot, phihp, 5 (other)": "0 of 1; 1 missing",
    }
    hours = float(found["pendulum, phihp, 1000"]["core-hours"])
    assert hours == pytest.approx(7 * 31.0 / 3600)  # one thread
    assert text(made, "Planned and done").startswith("7 of 13 planned cells are done")
    assert sum("the run failed: ValueError: a | b" in problem for problem in made.problems) == 2
    assert rows(runs)["3, pendulum"][-1] == "7 of 10, 7 of 10"


def test_core_hours_are_of_all_threads(tmp_path: Path) -> None:
    config = make_run(tmp_path) / "config.yaml"
    config.write_text(config.read_text() + "threads: 4\n")
    runs = read_runs(tmp_path).runs
    assert runs[0].core_hours == pytest.approx(4 * 31.0 / 3600)
    section = planned_section(read_planned(tmp_path), runs)
    assert section.text.startswith("No plan: there is no `planned.json`")
    assert not section.tables


def test_what_was_planned_and_is_missing_counts_in_the_family(tmp_path: Path) -> None:
    make_planned(tmp_path, *seeds(count=4))
    p = float(rows(tmp_path)["3, pendulum"][1].split("p = ")[1])
    tasks = ("pendulum", "acrobot", "cartpole")
    plan(tmp_path, *(cell for task in tasks for cell in seeds(task=task, count=4)))
    found = rows(tmp_path)
    assert float(found["3, pendulum"][1].split("p = ")[1]) == pytest.approx(3 * p, rel=0.05)
    assert found["3, acrobot"] == ["not run", "–", "–", "–", "0 of 4, 0 of 4"]
    assert "3, cartpole-swingup" not in found
    make(tmp_path, tmp_path)
    (gain,) = table(tmp_path, "planning_gain")
    assert float(gain["p"]) == pytest.approx(3 * p, rel=0.05)


def test_a_side_that_was_planned_and_is_missing_is_named(tmp_path: Path) -> None:
    make_planned(tmp_path, *seeds())
    plan(tmp_path, *seeds(count=4), *seeds("td3"), *seeds("td-mpc"))
    found = rows(tmp_path)
    for claim in (1, 2):
        verdict, *_, n = found[f"{claim}, pendulum"]
        assert (verdict, n) == ("not run", "3 of 4, 0 of 3")
    text = claims_section(Results(read_runs(tmp_path).runs, read_planned(tmp_path))).text
    assert "not run in 1 of 1 comparisons (not run: pendulum)" in text


def test_two_systems_with_samples_of_their_own_count_before_they_are_run(tmp_path: Path) -> None:
    both = ("td-mpc-star", "ph-td-mpc-star")
    plan(tmp_path, *(Cell(method, "pendulum", 100 + seed) for method in both for seed in range(3)))
    tmp_path.mkdir(exist_ok=True)
    planned = read_planned(tmp_path)
    (finding,) = hybrid_earns_more(Results((), planned))
    assert (finding.what, finding.verdict, finding.seeds) == (
        "Ph-TD-MPC* on pendulum",
        "not run",
        "0 of 3, 0 of 3",
    )
    for method in both:
        for seed in range(3):
            acting = {"actor": [float(seed)]}
            make_run(tmp_path, method, "pendulum", 100 + seed, 9000, acting=acting)
    (finding,) = hybrid_earns_more(Results(read_runs(tmp_path).runs, planned))
    assert (finding.what, finding.seeds) == ("Ph-TD-MPC* on pendulum, 9000 samples", "3, 3")


def test_seeds_that_were_planned_at_one_number_are_not_missing_at_others(tmp_path: Path) -> None:
    """Ten are planned at a half, five of them at a tenth too."""
    half = seeds(count=10)
    tenth = [Cell("phihp", "pendulum", cell.seed, 100) for cell in half[:5]]
    theirs = seeds("td-mpc")
    make_planned(tmp_path, *half, *tenth, *theirs)
    for cell in theirs:
        metrics = tmp_path / cell.name / "metrics.csv"
        metrics.write_text(metrics.read_text() + "policy,0,100,1,1,-900.0\n")
    plan(tmp_path, *half, *tenth, *theirs)
    assert rows(tmp_path)["1, pendulum"][-1] == "5, 3"


def test_systems_planned_at_different_samples_are_no_comparison(tmp_path: Path) -> None:
    """Both are done, and nothing was asked for that could be tested."""
    ours, theirs = (
        [Cell(method, "pendulum", 100 + seed, samples) for seed in range(3)]
        for method, samples in (("ph-cem", 500), ("dd-cem", 1000))
    )
    im = [Cell(f"td3-im-{kind}", "pendulum", 100 + seed, 1000) for kind in ("ph", "dd")
          for seed in range(3)]  # fmt: skip
    make_planned(tmp_path, *im)
    plan(tmp_path, *im)
    alone = rows(tmp_path)["4, TD3-im-ph on pendulum, 1000 samples"]
    make_planned(tmp_path, *ours, *theirs)
    plan(tmp_path, *ours, *theirs)
    assert rows(tmp_path) == {"4, TD3-im-ph on pendulum, 1000 samples": alone}  # of a family of one
    # A cell of one side at the samples of the other makes it one.
    plan(tmp_path, Cell("dd-cem", "pendulum", 100, 500))
    assert rows(tmp_path)["4, Ph-CEM on pendulum, 500 samples"] == [
        "not run",
        "–",
        "–",
        "–",
        "3, 0 of 1",
    ]


def test_a_comparison_at_equal_samples_is_missing_where_it_was_planned(tmp_path: Path) -> None:
    """Where nothing is done at equal samples, those that were planned are named."""
    cells = {
        (method, samples): [Cell(method, "pendulum", 100 + seed, samples) for seed in range(count)]
        for method, samples, count in (
            ("ph-cem", 500, 3), ("ph-cem", 1000, 4), ("dd-cem", 1000, 5), ("dd-cem", 2000, 6)
        )
    }  # fmt: skip
    make_planned(tmp_path, *cells["ph-cem", 500], *cells["dd-cem", 1000])
    plan(tmp_path, *(cell for group in cells.values() for cell in group))
    assert rows(tmp_path)["4, Ph-CEM on pendulum, 1000 samples"][-1] == "0 of 4, 5"


def test_runs_without_the_number_that_is_compared_are_not_missing(tmp_path: Path) -> None:
    cells = seeds()
    make_planned(tmp_path, *cells)
    plan(tmp_path, *cells)
    assert rows(tmp_path)["3, pendulum"][0] == "shown"
    for cell in cells:  # evaluate.episodes of the actor alone are missing
        path = tmp_path / cell.name / "evaluation.json"
        path.write_text(json.dumps({"planner": json.loads(path.read_text())["planner"]}))
    assert rows(tmp_path)["3, pendulum"] == ["not measured", "–", "–", "–", "0 of 3, 0 of 3"]
    text = claims_section(Results(read_runs(tmp_path).runs, read_planned(tmp_path))).text
    line = text.splitlines()[2]
    assert line.endswith("**: not measured in 1 of 1 comparisons (not measured: pendulum).")


def test_cells_of_the_twin_are_in_no_family_of_phihp(tmp_path: Path) -> None:
    cells = [Cell("phihp", "pendulum", 100 + seed) for seed in range(3)]
    twins = [Cell("dd-phihp", "pendulum", 100, samples) for samples in (200, 500)]
    make_planned(tmp_path, *cells)
    plan(tmp_path, *cells)
    make(tmp_path, tmp_path)
    (before,) = table(tmp_path, "planning_gain")
    plan(tmp_path, *twins)
    make(tmp_path, tmp_path)
    (after,) = table(tmp_path, "planning_gain")
    assert after["p"] == before["p"]
    assert {row["task, method, real samples"] for row in table(tmp_path, "planned")} == {
        "pendulum, phihp", "pendulum, dd-phihp, 200", "pendulum, dd-phihp, 500"
    }  # fmt: skip


def test_planned_seeds_are_those_of_the_samples_that_are_compared(tmp_path: Path) -> None:
    few = [Cell("phihp", "pendulum", 100 + seed, 500) for seed in range(3)]
    usual = [Cell("phihp", "pendulum", 100 + seed) for seed in range(10)]
    make_planned(tmp_path, *few)
    plan(tmp_path, *few, *usual)
    assert rows(tmp_path)["3, pendulum"][-1] == "3, 3"
    make_planned(tmp_path, *usual[:4])
    assert rows(tmp_path)["3, pendulum"][-1] == "4 of 10, 4 of 10"
    make(tmp_path, tmp_path)
    (gain, _) = table(tmp_path, "planning_gain")  # a family of two, by both rules
    p = float(rows(tmp_path)["3, pendulum"][1].split("p = ")[1])
    assert float(gain["p"]) == pytest.approx(2 * p, rel=0.05)


def test_the_samples_of_a_planned_cell() -> None:
    assert samples_of(Cell("phihp", "pendulum", 0, 500)) == 500
    assert samples_of(Cell("phihp", "pendulum", 0)) == 1000  # the default preset's
    for cell in (
        Cell("td-mpc", "pendulum", 0),
        Cell("phihp", "nobody-knows", 0),
        Cell("of-a-plugin", "pendulum", 0),
    ):
        assert samples_of(cell) is None


def test_baselines_that_were_planned_count_in_the_table_of_differences(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    make_planned(runs, *seeds(count=4), *(Cell("td3", "pendulum", s, 1000) for s in range(3)))
    make(tmp_path)
    (before,) = (row["p"] for row in table(tmp_path, "differences") if row["seeds"] == "4, 3")
    plan(runs, *seeds(count=4), *seeds("td-mpc"))
    make(tmp_path)
    (after,) = (row["p"] for row in table(tmp_path, "differences") if row["seeds"] == "4, 3")
    assert float(after) == pytest.approx(min(1.0, 2 * float(before)))


def test_trials_beside_cells_of_the_proof_are_named_and_left_out(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for seed in (100, 101, 102):
        config = make_run(runs, seed=seed) / "config.yaml"
        config.write_text(config.read_text() + f"evaluate: {{first_seed: {PROOF_SEED}}}\n")
    trial = make_run(runs, seed=0, acting={"planner": [-900.0], "actor": [-900.0]})
    made = make(tmp_path)
    assert [trial.name in problem for problem in made.problems] == [True]
    assert table(tmp_path, "main_return")[0]["PhIHP seeds"] == "3"
    assert "−900" not in (tmp_path / "overview.md").read_text()


def test_a_plan_that_cannot_be_read_ends_the_report(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    make_run(runs)
    for torn in ('["pendulum-default-seed0"]', "{"):
        (runs / "planned.json").write_text(torn)
        with pytest.raises(ConfigError, match=r"^runs: expected a description of each cell"):
            make(tmp_path)
    assert not (tmp_path / "report").exists()


def test_no_p_value_falls_as_a_family_grows() -> None:
    p_values = [0.04, math.nan, 0.01]
    assert holm(p_values, family=5) == pytest.approx([0.16, math.nan, 0.05], nan_ok=True)
    assert holm(p_values, family=1) == pytest.approx(holm(p_values), nan_ok=True)
