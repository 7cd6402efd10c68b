"""The scripts that make the report, and the sweep that it shows."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from kept_runs import make_run

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.deployment import Agent, save_agent
from phihp_torchrl.planners import CEMConfig

PLANNER = CEMConfig(
    planning_horizon=3, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2,
    replan_every=2,
)  # fmt: skip
"""The planner of the agent that is swept, so small that its episodes take no time."""


def test_the_script_makes_the_report_and_logs_its_figures(
    run_script: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rliable")
    pytest.importorskip("tensorboard")
    for seed in (0, 1):
        make_run(tmp_path / "results" / "runs", seed=seed)
    run_script("make_report", "reps=20", "logger=tensorboard")
    assert "wrote results/report/README.md" in capsys.readouterr().out
    with (tmp_path / "results/report/tables/main_return.csv").open() as file:
        row = next(csv.DictReader(file))
    assert (row["PhIHP mean"], row["PhIHP seeds"]) == ("-185.0", "2")
    overview_page = (tmp_path / "results/README.md").read_text()
    assert "### Returns with fewer real samples" in overview_page
    assert "2 evaluation episodes each" in overview_page
    assert list((tmp_path / "outputs" / "report").rglob("*tfevents*"))
    with pytest.raises(SystemExit, match=r"^error: reps: expected a whole number"):
        run_script("make_report", "reps=0")


@pytest.mark.slow
def test_sensitivity_is_swept_and_reported(
    run_script: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = get_task("pendulum")
    parts = {"actor": Actor(task, (4,)), "qvalue": TwinQ(task, (4,)), "planner_config": PLANNER}
    agent = save_agent(Agent(task, dynamics=HybridDynamics.hybrid(task), **parts), tmp_path / "a")
    run_script(
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
        run_script("sensitivity")
    with pytest.raises(SystemExit, match=r"^error: episodes: expected a whole number"):
        run_script("sensitivity", f"agent={agent}", "episodes=0")
