"""The script that takes back one departure of the default preset at a time."""

from __future__ import annotations

import json
import sys

import pytest

import departures
from phihp_torchrl.config import compose_yaml, flatten
from phihp_torchrl.trainers import read_request


@pytest.fixture
def script(tmp_path, monkeypatch):
    """The script, writing elsewhere."""
    monkeypatch.setattr(departures, "RESULTS", tmp_path)
    # What it sets for its process must not reach the tests after it.
    monkeypatch.setattr(departures.torch, "set_flush_denormal", lambda mode: True)
    monkeypatch.setattr(departures.torch, "set_num_threads", lambda number: None)
    return departures


def test_departures_are_those_of_the_task(script):
    found = script.departures("acrobot")
    assert found["policy.td3.value_expansion"] == 1
    assert found["planner.planning_horizon"] == 4
    assert not any(key.startswith(("td3.", "tdmpc.")) for key in found)
    assert "policy.td3.value_expansion" not in script.departures("cartpole-swingup")


def test_every_published_value_is_one_that_a_run_takes(script):
    """Of a value that several tasks have, one is enough."""
    taken = set()
    for task in ("pendulum-swingup", "acrobot", "cartpole-swingup"):
        composed = compose_yaml([f"task={task}"])
        for key, value in script.departures(task).items():
            words = script.changes(task, key)
            if (key, *words) in taken:
                continue
            taken.add((key, *words))
            config = read_request(composed, [f"task={task}", *words]).config
            assert flatten(config.to_mapping())[key] == value


def test_effects_in_words(script):
    role = {"default": -350.0, "difference": -12.34, "standard_error": 1.2}
    found = {"task": "acrobot", "value": 3, "planner": role, "actor": {**role, "difference": 2.0}}
    assert (
        script.describe("planner.alpha", found) == "acrobot: planner −12.3 ± 1.2, actor +2.0 ± 1.2"
    )
    errors = {"task": "acrobot", "error": 0.3, "default_error": 0.1}
    assert script.describe("model.activation", errors) == "acrobot: 20-step error × 3"
    assert script.describe("model.fit.method", errors) == (
        "acrobot: 20-step error × 3, with `model.fit.steps` and `model.warm_start`"
    )


def test_what_is_measured_is_written_and_not_measured_again(script, tmp_path, monkeypatch):
    run = tmp_path / "runs" / "acrobot-default-n500-seed0"
    run.mkdir(parents=True)
    (run / "evaluation.json").write_text("{}")
    asked = []

    def measure(task, key, base, out):
        asked.append(key)
        return {"value": 1, "error": 2.0, "default_error": 1.0}

    monkeypatch.setattr(script, "measure", measure)
    arguments = ["departures.py", "--runs", str(tmp_path / "runs"), "--tasks", "acrobot"]
    monkeypatch.setattr(sys, "argv", arguments)
    script.main()
    assert "planner.warm_start" in asked
    assert "policy.updates" not in asked
    entries = json.loads((tmp_path / "departures.json").read_text())
    assert entries["planner.warm_start"]["effect"] == "acrobot: 20-step error × 2"
    assert "| `planner.warm_start` | 1 |" in (tmp_path / "README.md").read_text()
    asked.clear()
    script.main()
    assert asked == []


def test_runs_that_are_not_there(script, tmp_path, monkeypatch):
    monkeypatch.setattr(
        sys, "argv", ["departures.py", "--runs", str(tmp_path), "--tasks", "acrobot"]
    )
    with pytest.raises(SystemExit, match="expected a finished run of acrobot"):
        script.main()
