"""Whole runs in worlds of others keep to their budget, are not repeated, and are reported."""

from __future__ import annotations

import csv
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

import published_scores
import world_scores
from other_worlds import WORLDS
from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import RunDirectory
from tests.docs.conftest import TINY

ROOT = Path(__file__).parents[3]
_SPEC = importlib.util.spec_from_file_location(  # tests/worlds has the name
    "benchmarks_worlds", ROOT / "benchmarks/paper/worlds.py"
)
worlds = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = worlds
_SPEC.loader.exec_module(worlds)
ENTRIES = worlds.ENTRIES
SHORT = [f"{key}={str(value).lower()}" for key, value in TINY.items()]


@pytest.mark.parametrize("name", ENTRIES)
def test_a_run_is_told_its_budget_and_what_is_known_of_the_simulator_alone(name):
    entry = ENTRIES[name]
    lines = dict(line.split("=") for line in worlds.settings(entry, 100))
    told = {f"model.{key}": str(value) for key, value in WORLDS[entry.world].model.items()}
    steps = lines.pop("model.real_steps", None)
    assert {key: value for key, value in lines.items() if key.startswith("model.")} == told
    assert not [key for key in lines if key.startswith(("policy.", "planner."))]
    if entry.environment_steps is not None:
        assert int(steps) * WORLDS[entry.world].repeat == entry.environment_steps


@pytest.mark.slow
def test_a_finished_run_is_read_and_not_repeated(tmp_path):
    path = tmp_path / "run"
    found = worlds.train("pendulum-v1", 3, path, SHORT)
    rows = RunDirectory(path).metrics.read_text()
    assert worlds.train("pendulum-v1", 3, path, SHORT) == found
    assert RunDirectory(path).metrics.read_text() == rows
    assert found["environment_steps"] == found["transitions"] == TINY["model.real_steps"]
    assert set(found["returns"]) == {"planner", "actor"}
    with pytest.raises(ConfigError, match="seed"):
        worlds.train("pendulum-v1", 4, path, SHORT)


def finished(task, seed, planner):
    return {
        "task": task,
        "seed": seed,
        "environment_steps": 2000,
        "returns": {"planner": [planner, planner], "actor": [planner - 10, planner - 30]},
        "target": 800.0,
        "policy": {},
        "metrics": {"policy/best_imagined_return": 812.5},
        "seconds": {"model": 3.0},
        "origin": {
            "commit": "a" * 40,
            "dirty": False,
            "machine": {"cpus": 2, "memory_gib": 24.0, "gpus": 0},
        },
    }


def test_the_table_has_means_over_seeds_beside_the_scores_of_others(tmp_path):
    for seed, planner in ((100, 700.0), (101, 800.0)):
        run = finished("pendulum-swingup", seed, planner)
        (tmp_path / f"pendulum-swingup-{seed}.json").write_text(json.dumps(run))
    header = ",".join(published_scores.COLUMNS)
    row = "pendulum-swingup,SAC,100000,50.0,0.0,100.0,3,somewhere"
    (tmp_path / world_scores.PUBLISHED).write_text(f"{header}\n{row}\n")
    world_scores.write_report(tmp_path, ["pendulum-swingup", "acrobot-swingup"])
    text = (tmp_path / "README.md").read_text()
    assert "| pendulum-swingup | PhIHP | 2,000 | 750.0 | 700.0 to 800.0 | 2 | 800 |" in text
    assert "| PhIHP, the actor alone | 2,000 | 730.0 | 680.0 to 780.0 | 2 | 800 |" in text
    assert "| pendulum-swingup | SAC | 100,000 | 50.0 | 0.0 to 100.0 | 3 |  |" in text
    assert "Not run yet: acrobot-swingup." in text
    short = world_scores.brief(tmp_path, ["pendulum-swingup", "acrobot-swingup"])
    assert "| pendulum-swingup | 2 | 2,000 | 750 (700 to 800) | – | – | 50 (100,000) |" in short
    assert "acrobot" not in short
    assert (tmp_path / "scores.png").stat().st_size > 1000


@pytest.fixture
def repository(tmp_path):
    folder = tmp_path / "results" / "sac"
    folder.mkdir(parents=True)
    rows = [f"{step},{score},{seed}" for step in (0, *published_scores.STEPS[:3])
            for seed, score in ((1, 3.0), (2, 6.0))]  # fmt: skip
    (folder / "short.csv").write_text("\n".join(["step,reward,seed", *rows]))
    last = [f"{published_scores.STEPS[3]},9.0,1"]
    (folder / "task.csv").write_text("\n".join(["step,reward,seed", *rows, *last]))
    author = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], [*author, "commit", "-q", "-m", "scores"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    return tmp_path


def test_scores_of_others_are_read_with_their_source(repository):
    rows = published_scores.read(repository, "sac", "task")
    assert [row[2:7] for row in rows] == [
        ["100000", "4.5", "3.0", "6.0", "2"],
        ["200000", "4.5", "3.0", "6.0", "2"],
        ["500000", "4.5", "3.0", "6.0", "2"],
        ["1000000", "9.0", "9.0", "9.0", "1"],
    ]
    assert all("results/sac/task.csv" in row[-1] for row in rows)
    with pytest.raises(ValueError, match=r"short\.csv: expected scores at step 1000000"):
        published_scores.read(repository, "sac", "short")


def test_every_kept_score_names_its_file_and_commit():
    with (ROOT / published_scores.OUT).open() as file:
        rows = list(csv.DictReader(file))
    per_task = len(published_scores.METHODS) * len(published_scores.STEPS)
    assert len(rows) == len(published_scores.TASKS) * per_task
    for row in rows:
        place, path, commit = row["source"].split()
        assert place == published_scores.REPOSITORY
        assert path.endswith(f"/{row['task']}.csv")
        assert len(commit) == 40
        assert 0 <= float(row["lowest"]) <= float(row["mean"]) <= float(row["highest"]) <= 1000
