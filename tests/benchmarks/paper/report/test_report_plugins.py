"""Reports on what the paper does not have: tasks, methods and worlds of one's own."""

from __future__ import annotations

from pathlib import Path

import pytest
from kept_runs import make, make_run, results, table, text

from phihp_torchrl.config import METHODS, Method, register_method
from report import NOT_RUN, Table, read_run, systems
from report.ablation import ablation
from report.efficiency import ONE_NUMBER
from report.main_table import main_table
from report.results import TASKS


@pytest.fixture(autouse=True)
def registries(monkeypatch: pytest.MonkeyPatch) -> None:
    """The methods, as they were again after the test."""
    monkeypatch.setattr(METHODS, "_entries", dict(METHODS._entries))


def column(tmp_path: Path, name: str, key: str) -> dict[str, str]:
    return {row[next(iter(row))]: row[key] for row in table(tmp_path, name)}


def cell(made: Table, row: str, key: str) -> str:
    return str(next(of for of in made.rows if of[0] == row)[list(made.header).index(key)])


def test_rows_are_those_of_the_registry_in_the_papers_order() -> None:
    assert [one.name for one in systems()] == [
        "PhIHP", "TD-MPC", "TD3", "CEM-oracle", "TD-MPC*", "Ph-TD-MPC*", "dd-CEM", "Ph-CEM",
        "dd-PhIHP", "TD3-im-ph", "TD3-im-dd",
    ]  # fmt: skip
    assert {one.sources[0][0] for one in systems()} == set(METHODS)
    assert [one.name for one in systems("imagined")] == ["TD3-im-ph", "TD3-im-dd"]


def test_a_task_of_ones_own_is_in_the_tables_without_a_target(tmp_path: Path) -> None:
    pytest.importorskip("rliable")
    for seed in (0, 1):
        make_run(tmp_path / "runs", seed=seed, error=0.1)
        make_run(
            tmp_path / "runs",
            task="my-task",
            seed=seed,
            samples=300,
            error=0.2,
            curve=((300, -5.0),),
            acting={"planner": [-3.0, -4.0], "actor": [-5.0, -6.0]},
        )
        make_run(tmp_path / "runs", "td3", "my-task", seed, 900, kind=None,
                 acting={"actor": [-8.0, -9.0]})  # fmt: skip
    made = make(tmp_path)
    assert made.problems == ()
    assert column(tmp_path, "main_return", "PhIHP mean")["my-task"] == "-3.5"
    assert column(tmp_path, "main_return", "PhIHP, published")["my-task"] == "–"
    assert column(tmp_path, "main_samples", "PhIHP to")["my-task"] == ONE_NUMBER
    assert column(tmp_path, "differences", "difference")["my-task, TD3"] != NOT_RUN
    assert column(tmp_path, "generalization", "return mean")["my-task, hybrid"] == "-3.5"
    own = {row["task"]: row for row in table(tmp_path, "time_to_return")}["my-task"]
    assert (own["return"], own["reached by"], own["s in all mean"]) == ("–", "–", "30.0")
    # Returns without bounds are on no scale, and in no average.
    ablated = {row["task, system"]: row for row in table(tmp_path, "ablation")}["my-task, PhIHP"]
    assert ablated["normalised return mean"] == "–"
    assert ablated["real samples to 90 % to"] == ONE_NUMBER
    assert "my-task" not in column(tmp_path, "aggregates_mean", "PhIHP")
    gains = {row["task"] for row in table(tmp_path, "planning_gain")}
    assert gains == {"pendulum", "my-task"}
    assert "my-task" not in text(made, "The paper's claims")
    page = (tmp_path / "overview.md").read_text()
    assert "| my-task | 2 | 300 | −3.5 ± 0.0 | −5.5 ± 0.0 | – | – | – |" in page


def test_the_papers_tasks_stay_when_there_are_none_of_ones_own(tmp_path: Path) -> None:
    make_run(tmp_path)
    assert results(tmp_path).tasks == TASKS
    make_run(tmp_path, task="my-task")
    assert results(tmp_path).tasks == (*TASKS, "my-task")


@pytest.mark.parametrize("group", ["baseline", "ablation"])
def test_a_method_of_ones_own_is_a_row_or_a_column(tmp_path: Path, group: str) -> None:
    method = Method("Mine", "of one's own", ("model", "evaluate"), acting="actor", group=group)
    register_method("mine", method)
    assert [one.name for one in systems(group)][-1] == "Mine", "after the paper's"
    make_run(tmp_path)
    make_run(tmp_path, "mine", acting={"actor": [-7.0, -9.0], "planner": [0.0]}, ms=3.0)
    found = results(tmp_path)
    if group == "baseline":
        returns = main_table(found).tables["Return"]
        assert cell(returns, "pendulum", "Mine") == "−8.0 (1)"
        assert cell(returns, "pendulum", "Mine, published") == "–"
    else:
        assert cell(ablation(found).tables["By task"], "pendulum, Mine", "ms for an action") == (
            "3.00 (1)"
        )


def test_a_plugin_may_register_it(tmp_path: Path) -> None:
    (tmp_path / "my_method.py").write_text(
        "from phihp_torchrl.config import Method, register_method\n"
        "register_method('plugged', Method('Plugged', 'in', ('model',), group='baseline'))\n"
    )
    make_run(tmp_path / "runs", "plugged", acting={"planner": [-7.0]})
    make(tmp_path, plugins=(str(tmp_path / "my_method.py"),))
    assert column(tmp_path, "main_return", "Plugged mean")["pendulum"] == "-7.0"


def test_a_run_in_another_world_is_of_no_task_of_the_paper(tmp_path: Path) -> None:
    make_run(tmp_path / "runs", world="simulated")
    folder = make_run(tmp_path / "runs", seed=1, world="gymnasium", acting={"planner": [-1.0]})
    (folder / "cell.json").unlink()
    run = read_run(folder.rename(tmp_path / "runs" / "pendulum-own-seed1"))
    assert (run.task, run.label) == ("pendulum in gymnasium", "own")
    returns = main_table(results(tmp_path / "runs")).tables["Return"]
    assert cell(returns, "pendulum", "PhIHP") == "−185.0 (1)"
    assert cell(returns, "pendulum in gymnasium", "PhIHP") == "−1.0 (1)"
    assert cell(returns, "pendulum in gymnasium", "PhIHP, published") == "–"
