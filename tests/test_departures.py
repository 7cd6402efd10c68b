"""The recipe that takes back one departure of the default preset at a time."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from phihp_torchrl.trainers import read_request

RECIPES = Path(__file__).parents[1] / "recipes"


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES))
    spec = importlib.util.spec_from_file_location("departures_recipe", RECIPES / "departures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    # What a recipe sets for its process must not reach the tests after it.
    monkeypatch.setattr(module.torch, "set_flush_denormal", lambda mode: True)
    monkeypatch.setattr(module.torch, "set_num_threads", lambda number: None)
    return module


def test_departures_are_those_of_the_task(recipe):
    found = recipe.departures("acrobot")
    assert found["policy.td3.value_expansion"] == 1
    assert found["planner.planning_horizon"] == 4
    assert not any(key.startswith(("td3.", "tdmpc.")) for key in found)
    assert "policy.td3.value_expansion" not in recipe.departures("pendulum-swingup")


@pytest.mark.parametrize("task", ["pendulum-swingup", "acrobot", "cartpole-swingup"])
def test_every_published_value_is_one_that_the_recipes_take(recipe, task):
    with initialize_config_dir(str(RECIPES / "config"), version_base="1.3"):
        paper = recipe.settings("paper")
        for key, value in recipe.departures(task).items():
            changes = [f"task={task}", f"{key}={recipe.override(value)}"]
            changes += [f"{k}={recipe.override(paper[k][task])}"
                        for k in recipe.TOGETHER.get(key, ())]  # fmt: skip
            read_request(compose("phihp", changes), changes)


def test_effects_in_words(recipe):
    role = {"default": -350.0, "difference": -12.34, "standard_error": 1.2}
    found = {"task": "acrobot", "value": 3, "planner": role, "actor": {**role, "difference": 2.0}}
    assert (
        recipe.describe("planner.alpha", found) == "acrobot: planner −12.3 ± 1.2, actor +2.0 ± 1.2"
    )
    errors = {"task": "acrobot", "error": 0.3, "default_error": 0.1}
    assert recipe.describe("model.activation", errors) == "acrobot: 20-step error × 3"
    assert recipe.describe("model.fit.method", errors) == (
        "acrobot: 20-step error × 3, with `model.fit.steps` and `model.warm_start`"
    )


def test_what_is_measured_is_written_and_not_measured_again(recipe, tmp_path, monkeypatch):
    run = tmp_path / "runs" / "acrobot-default-n500-seed0"
    run.mkdir(parents=True)
    (run / "evaluation.json").write_text("{}")
    asked = []

    def measure(task, key, base, out):
        asked.append(key)
        return {"value": 1, "error": 2.0, "default_error": 1.0}

    monkeypatch.setattr(recipe, "measure", measure)
    arguments = ["departures.py", "--runs", str(tmp_path / "runs"), "--tasks", "acrobot"]
    monkeypatch.setattr(sys, "argv", arguments)
    recipe.main()
    assert "planner.warm_start" in asked
    assert "policy.updates" not in asked
    entries = json.loads((tmp_path / "departures.json").read_text())
    assert entries["planner.warm_start"]["effect"] == "acrobot: 20-step error × 2"
    assert "| `planner.warm_start` | 1 |" in (tmp_path / "README.md").read_text()
    asked.clear()
    recipe.main()
    assert asked == []


def test_runs_that_are_not_there(recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(
        sys, "argv", ["departures.py", "--runs", str(tmp_path), "--tasks", "acrobot"]
    )
    with pytest.raises(SystemExit, match="expected a finished run of acrobot"):
        recipe.main()
