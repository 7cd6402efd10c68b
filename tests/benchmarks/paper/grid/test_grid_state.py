"""Which cells a grid has, how they stand and how that is shown."""

from __future__ import annotations

import json
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from grid_cells import YAML

from grid import Cell, CellFiles, GridConfig, LiveTable, Status, look, swept_cells
from grid.claim import claim
from grid.display import summary, table
from grid.keep import keep_names
from phihp_torchrl.config import ConfigError


def test_the_grid_is_the_product_in_the_launchers_order(tmp_path: Path) -> None:
    base = {key: value for key, value in YAML.items() if key not in ("defaults", "hydra")}
    overrides = ["task=pendulum,acrobot", "seed=range(2)", "share=1,null", "launcher=joblib"]
    with pytest.raises(ConfigError, match="launcher: unknown key"):
        swept_cells({**base, "launcher": "joblib"}, overrides, tmp_path)
    names = [files.cell.name for files in swept_cells(base, overrides, tmp_path)]
    assert names == [
        "pendulum-default-n2000-seed0",
        "pendulum-default-seed0",
        "pendulum-default-n2000-seed1",
        "pendulum-default-seed1",
        "acrobot-default-n5000-seed0",
        "acrobot-default-seed0",
        "acrobot-default-n5000-seed1",
        "acrobot-default-seed1",
    ]


def test_the_table_has_a_row_for_each_setting(config: GridConfig) -> None:
    states = {}
    for seed in (0, 1):
        files = replace(config, seed=seed).files(Path())
        states[files] = look(files)
    assert table(states)[1:] == ["phihp   pendulum  60       default  waiting  waiting"]
    assert summary([*states.values()]) == "2 cells: 2 waiting"


def test_the_planned_cells_of_all_commands_are_noted(config: GridConfig, tmp_path: Path) -> None:
    def cells(*seeds: int, **changes: str) -> list[CellFiles]:
        return [replace(config, seed=seed, **changes).files(Path()) for seed in seeds]

    elsewhere = cells(7, results=str(tmp_path / "elsewhere"))
    keep_names([*cells(1, 0), *elsewhere])
    keep_names(cells(2, 1))
    names = [files.cell.name for files in cells(0, 1, 2)]
    noted = json.loads((Path(config.results) / "planned.json").read_text())
    assert [*noted] == names
    assert [Cell(**cell) for cell in noted.values()] == [f.cell for f in cells(0, 1, 2)]
    assert len(json.loads(elsewhere[0].planned.read_text())) == 1


@pytest.mark.parametrize("torn", ['["pendulum-seed0"]', "{", '{"a": 3}', '{"a": {"task": "b"}}'])
def test_an_earlier_plan_that_cannot_be_read_is_kept_and_named(
    config: GridConfig, torn: str
) -> None:
    planned = config.files(Path()).planned
    planned.parent.mkdir(parents=True, exist_ok=True)
    planned.write_text(torn)
    with pytest.raises(ConfigError, match=r"^results: expected a description of each cell in"):
        keep_names([config.files(Path())])
    assert planned.read_text() == torn


def test_a_plan_that_another_process_writes_is_not_written_over(
    config: GridConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules["grid.keep"], "_WAIT", 0.0)  # `grid.keep` is a function
    planned = config.files(Path()).planned
    with claim(planned.with_name(".planned.json.lock")) as ours:
        assert ours
        with pytest.raises(ConfigError, match=r"^results: expected to write .*planned\.json"):
            keep_names([config.files(Path())])
    assert not planned.exists()


def test_workers_get_a_table_that_shows_nothing() -> None:
    live = LiveTable()
    live._lines = 7
    assert pickle.loads(pickle.dumps(live))._lines == 0


def test_half_written_files_say_what_they_are(config: GridConfig) -> None:
    files = config.files(Path())
    files.run.mkdir(parents=True)
    files.failure.write_text("{")
    assert "cannot be read" in look(files).detail
    files.failure.unlink()
    (files.run / "config.yaml").write_text("task: pendulum\n")
    (files.run / "metrics.csv").write_text("phase,unit,real_steps,seconds\nmodel,0,30")
    assert (look(files).status, look(files).detail) == (Status.STOPPED, "")
    files.kept.mkdir(parents=True)
    files.evaluation.write_text("{}")
    assert (look(files).status, look(files).detail) == (Status.DONE, "unreadable")


def test_names_are_files() -> None:
    assert Cell("ph-cem", "acrobot", 3, 5000, "paper").name == "acrobot-ph-cem-paper-n5000-seed3"
    with pytest.raises(ConfigError, match="label: expected letters"):
        Cell("phihp", "acrobot", 0, label="..")
