"""Reports on disk: pages, tables and figures."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest
from kept_runs import make, make_run, table, text
from matplotlib.figure import Figure

from measures import DEFAULT_SAMPLES
from report import (
    NOT_RUN,
    Number,
    Stat,
    Table,
    Trial,
    write_trials,
)
from report.sections import Picture, Section
from report.write import put_between, write_report


def test_the_whole_report(tmp_path: Path) -> None:
    """Its pictures can be drawn; that drawn ones are written is another test's."""
    pytest.importorskip("rliable")
    runs = tmp_path / "runs"
    for seed in (0, 1):
        for task in ("pendulum", "pendulum-swingup", "cartpole", "cartpole-swingup", "acrobot",
                     "acrobot-swingup"):  # fmt: skip
            for share in (5, 1):
                samples = DEFAULT_SAMPLES[task] // share
                make_run(runs, task=task, seed=seed, samples=samples, error=0.01)
            make_run(runs, "dd-cem", task, seed, samples, acting={"planner": [-400.0 - seed]},
                     kind="data_driven", error=0.1)  # fmt: skip
    make_run(runs, label="paper", seed=3)
    trials = [Trial("pendulum", 0, "planning_horizon", h, -180.0 - h, 1.0, 5, h) for h in (1, 4)]
    write_trials(tmp_path / "sensitivity" / "pendulum.json", trials)
    (tmp_path / "sensitivity" / "torn.json").write_text("[{")
    (tmp_path / "latency").mkdir()
    (tmp_path / "latency" / "acrobot.json").write_text("{")
    made = make(tmp_path)
    assert ["torn.json" in made.problems[0], "acrobot.json" in made.problems[1]] == [True, True]
    assert len(made.problems) == 2

    page = (tmp_path / "report" / "README.md").read_text()
    for section in made.sections:
        assert f"## {section.title}\n" in page
        for made_table in section.tables.values():
            assert table(tmp_path, made_table.name)
        for picture in section.pictures:
            picture.figure.draw_without_rendering()
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
    glance = {row["system"]: row for row in table(tmp_path, "at_a_glance")}
    assert glance["PhIHP"]["real samples to 90 %"] == "≤ 617"
    assert glance["PhIHP"]["seeds"] == "2"
    assert float(glance["PhIHP"]["normalised return"]) == pytest.approx(
        float(over["PhIHP"]["mean"])
    )
    assert glance["PhIHP"]["ms for an action"] == glance["TD3"]["normalised return"] == NOT_RUN
    assert float(glance["TD3"]["real samples to 90 %, published"]) == pytest.approx(168_500)
    assert "## paper" in (tmp_path / "overview.md").read_text()


def test_the_same_runs_make_the_same_files(tmp_path: Path) -> None:
    make_run(tmp_path / "runs")
    made = []
    for _ in range(2):
        make(tmp_path)
        kept = sorted(p for p in (tmp_path / "report").rglob("*") if p.is_file())
        made.append({path.name: path.read_bytes() for path in kept})
        shutil.rmtree(tmp_path / "report")
    assert made[0] == made[1]


@pytest.mark.usefixtures("drawn")
def test_the_same_picture_makes_the_same_files(tmp_path: Path) -> None:
    made = []
    for _ in range(2):
        figure = Figure(layout="constrained")
        figure.subplots().plot([0, 1], [1, 2], label="a line")
        section = Section("Title", pictures=[Picture("a_picture", figure, "What it shows")])
        write_report(tmp_path, "Report", "", [section])
        figures = sorted((tmp_path / "figures").iterdir())
        assert [path.name for path in figures] == ["a_picture.png", "a_picture.svg"]
        made.append([path.read_bytes() for path in figures])
        shutil.rmtree(tmp_path)
    assert made[0] == made[1]


def test_without_the_extra_the_rest_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_run(tmp_path / "runs")
    monkeypatch.setitem(__import__("sys").modules, "rliable", None)
    made = make(tmp_path)
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
    page, (start, end) = tmp_path / "page.md", ("<!-- a -->", "<!-- b -->")
    assert not put_between(page, start, end, "new")
    page.write_text(f"{end} {start}")
    assert not put_between(page, start, end, "new")
    assert page.read_text() == f"{end} {start}"
    page.write_text(f"# Page\n\n{start}\nold\n{end}\n\nThe end.\n")
    assert put_between(page, start, end, "new")
    assert page.read_text() == f"# Page\n\n{start}\nnew\n{end}\n\nThe end.\n"
