"""The tracking motor: controllers that are tuned, those beside an agent, and the page."""

from __future__ import annotations

import json

import pytest

import tracking
import tracking_episodes
import tuned_controllers
from phihp_torchrl import Agent, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.baselines import LQI
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import CalibrateConfig, import_plugins


@pytest.fixture(scope="module", autouse=True)
def rig():
    import_plugins([str(tracking.RIGS / "motor.py")])


NUMBERS = {"planning_horizon": 2, "num_candidates": 8, "top_k": 2, "num_policy_candidates": 1}
SEARCH = {"kind": "cem", **NUMBERS}


def test_an_lqr_in_the_prior_keeps_its_speed_in_every_world() -> None:
    task = get_task("motor-preview")
    lqi = LQI.from_model(task, HybridDynamics.pure_prior(task))
    for changes in tracking_episodes.WORLDS.values():
        options = {"episodes": 4, "seed": 0, "steps": 150, "constant": True}
        speeds, references = tracking_episodes.play(lqi, task, changes, **options)
        assert (speeds - references)[-25:].abs().max() < 0.05


def test_all_are_measured_in_the_same_worlds(tmp_path, monkeypatch) -> None:
    task = get_task("motor")
    agent = Agent(
        task,
        dynamics=HybridDynamics.pure_prior(task),
        actor=Actor(task),
        planner_config=CEMConfig(**NUMBERS),
        metadata={"seconds": 1.0},
    )
    monkeypatch.setattr(tracking, "train", lambda *arguments: agent)
    few = CalibrateConfig(episodes=2, max_episodes=2, budget=1)
    monkeypatch.setattr(tracking, "CalibrateConfig", lambda: few)
    monkeypatch.setattr(tracking, "load_config", lambda name: {"planner": SEARCH})
    play = tracking_episodes.play

    def short(*arguments, steps=None, **options):
        return play(*arguments, steps=12, **options)

    for module in (tracking_episodes, tuned_controllers):
        monkeypatch.setattr(module, "play", short)
    words = ["--tasks", "motor", "--episodes", "2", "--tries", "1", "--results", f"{tmp_path}"]
    tracking.main(words)
    tuned, beside = (json.loads((tmp_path / f"{name}.json").read_text())
                     for name in ("motor", "motor-100"))  # fmt: skip
    assert list(tuned["measured"]) == [
        f"{name}, {by}"
        for name in ("PI", "LQR with integral action")
        for by in ("least RMS error", "highest return")
    ]
    assert list(beside["measured"]) == [
        f"{name}, seed 100"
        for name in ("planner", "planner that settles", "actor", "LQR with integral action")
    ]
    for found in (*tuned["measured"].values(), *beside["measured"].values()):
        assert found.keys() == tracking_episodes.WORLDS.keys()
    again = json.loads((tmp_path / "motor-100-calibrated.json").read_text())
    assert again["calibration"]["acting"] in ("planner", "actor")
    (found,) = again["measured"].values()
    assert found.keys() == tracking_episodes.WORLDS.keys()
    (tmp_path / "motor-100-calibrated.json").unlink()
    tracking.main([*words, "--only-calibrated"])
    assert (tmp_path / "motor-100-calibrated.json").is_file()
    page = (tmp_path / "README.md").read_text()
    assert "| motor | agent as calibrated, seed 100 | load of 0.2 Nm |" in page
    assert "effort = 0.1" in page or "effort = 0.01" in page
    assert "| motor | LQR with integral action, seed 100 | load of 0.2 Nm |" in page
