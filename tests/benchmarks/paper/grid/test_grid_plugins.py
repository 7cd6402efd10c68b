"""Cells of tasks, methods and worlds that a plugin registers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from grid_cells import TINY, do

from grid import GridConfig, Status
from phihp_torchrl.config import METHODS, ConfigError, choices
from phihp_torchrl.tasks import registry
from report import read_run

PLUGIN = """
from dataclasses import replace
from phihp_torchrl import get_task, register_method, register_task
from phihp_torchrl.config import Method

register_task(replace(get_task("pendulum"), name="gridded", max_steps=20))
register_method(
    "prior-alone",
    Method(
        "Prior",
        "plain CEM in the prior alone",
        ("model", "evaluate"),
        acting="plain_planner",
        model_kind="prior",
        changes={"planner": {"num_policy_candidates": 0}},
        samples_key="model.real_steps",
    ),
)
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    for entries in (METHODS, registry._TASKS):
        monkeypatch.setattr(entries, "_entries", dict(entries._entries))
    monkeypatch.setattr(choices, "_OFFERED", dict(choices._OFFERED))
    path = tmp_path / "grid_plugin.py"
    path.write_text(PLUGIN)
    return str(path)


def fit_for_cem() -> tuple[str, ...]:
    unfit = ("policy.", "calibrate.", "planner.num_policy_candidates")
    return tuple(word for word in TINY if not word.startswith(unfit))


def test_a_cell_of_a_plugin_is_run_and_kept(config: GridConfig, plugin: str) -> None:
    with pytest.raises(ConfigError, match=r"^method: expected one of .*'prior-alone'"):
        replace(config, method="prior-alone")
    words = (*fit_for_cem(), "model.real_steps=60")
    of_plugin = {"method": "prior-alone", "task": "gridded", "share": None}
    cell = replace(config, **of_plugin, overrides=words, plugins=(plugin,))
    state = do(cell)
    assert state.status is Status.DONE, state
    kept = cell.files(Path()).kept
    run = read_run(kept)
    assert (run.method, run.task, run.samples, run.kind) == ("prior-alone", "gridded", 60, "prior")
    assert json.loads((kept / "prediction.json").read_text())["reset_mean"] > 0
    with pytest.raises(ConfigError, match=r"^share: expected null for 'gridded'"):
        replace(cell, share=0.5)
    # Of a task with a published number, its samples key takes the share.
    assert "model.real_steps=1000" in replace(cell, task="pendulum", share=0.5).words()


def test_a_cell_in_another_world_has_no_truth_to_be_measured_by(config: GridConfig) -> None:
    cell = replace(config, overrides=(*TINY, "world=gymnasium", "world.id=Pendulum-v1"))
    state = do(cell)
    assert state.status is Status.DONE, state
    kept = cell.files(Path()).kept
    assert json.loads((kept / "prediction.json").read_text()) == {}
    assert read_run(kept).task == "pendulum in gymnasium"
    assert do(cell) == state
