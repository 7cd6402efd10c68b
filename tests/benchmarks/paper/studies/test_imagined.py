"""Policies that are trained in fitted models, for studies without a real step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import PolicyTrainer
from studies import study, train

TINY = ["policy.updates=8", "policy.random_steps=64", "policy.num_worlds=8", "policy.batch_size=8",
        "policy.evaluation_interval=8", "policy.evaluation_episodes=2", "policy.planned=0",
        "policy.evaluation_steps=5", "policy.refit.interval=0"]  # fmt: skip


def test_plans_of_one_training_play_the_same_episodes() -> None:
    trained = train("pendulum", 3, TINY, PolicyTrainer)
    search = CEMConfig(planning_horizon=2, num_candidates=8, num_policy_candidates=2, top_k=2)
    returns = trained.plan(2, search)
    assert len(returns) == 2
    assert trained.plan(2, search) == returns
    other = CEMConfig(planning_horizon=2, num_candidates=8, num_policy_candidates=0, top_k=2)
    assert trained.plan(2, other) != returns


def test_a_study_measures_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[tuple[str, int]] = []

    def measure(task: str, seed: int) -> dict[str, int]:
        measured.append((task, seed))
        return {"twice": 2 * seed}

    def page(runs: Sequence[dict[str, Any]]) -> str:
        assert all(run["origin"]["seed"] == run["seed"] for run in runs)
        return str([(run["task"], run["seed"], run["twice"]) for run in runs])

    for seeds in (["5"], ["4", "5"]):
        words = ["study", "--tasks", "acrobot", "--seeds", *seeds, "--results", str(tmp_path)]
        monkeypatch.setattr("sys.argv", words)
        study("A study.", tmp_path / "unused", measure, page)
    assert measured == [("acrobot", 5), ("acrobot", 4)]
    assert (tmp_path / "README.md").read_text() == "[('acrobot', 4, 8), ('acrobot', 5, 10)]"
