"""The comparison of ways to learn in imagination: its numbers, its table, and what it repeats."""

from __future__ import annotations

import json
import sys

import pytest

import analytic
from phihp_torchrl.origin import describe_origin


def made(task, method, seed, budget):
    step = 2.0 if method == "td3" else 1.0
    points = [
        {"seconds": step * k, "updates": 100.0 * k, "imagined": 10.0 * k, "real": 9.0 * k + seed}
        for k in range(6)
    ]
    points[-1]["imagined"] = 45.0  # worse than nothing kept before would be 50, better than 40
    if method == "analytic":
        for point in points[1:]:
            point["limited_share"] = 0.25
    return {
        "task": task,
        "method": method,
        "seed": seed,
        "budget": budget,
        "settings": analytic.settings(method, seed),
        "points": points,
        "origin": describe_origin(seed),
    }


def test_a_good_policy_is_found_at_the_first_point_of_the_level():
    run = made("pendulum", "td3", 0, 60.0)
    assert analytic.best(run)["imagined"] == 45.0
    assert analytic.good_after(run, 30.0) == 6.0
    assert analytic.good_after(run, 46.0) is None


def test_the_table_has_a_row_for_each_method_and_runs_are_not_repeated(tmp_path, monkeypatch):
    runs = []

    def run(*arguments):
        runs.append(arguments)
        return made(*arguments)

    line = ["analytic.py", "--tasks", "pendulum", "--seeds", "1", "2", "--results", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", line)
    analytic.main(run)
    analytic.main(run)
    assert len(runs) == 4
    page = (tmp_path / "README.md").read_text()
    # 90 % of the way from 0 to 45 is 40.5, so the level is reached at the last point.
    assert "| pendulum | td3 | 2 | 20.0 | 500 | 45.0 ± 0.0 | 46.5 ± 6.4 | 10 (2 of 2) |" in page
    assert "| analytic | 2 | 10.0 | 500 |" in page
    assert "5 (2 of 2) | 25.0 %" in page
    monkeypatch.setattr(sys, "argv", [*line, "--budget", "7"])
    with pytest.raises(SystemExit):
        analytic.main(run)
    assert json.loads((tmp_path / "pendulum-td3-seed1.json").read_text())["budget"] == 60.0
