"""The script that runs a grid, its methods and its launchers."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from grid_cells import PAPER, TINY, YAML
from hydra import compose, initialize_config_dir

from grid import GridConfig
from phihp_torchrl.config import METHODS, compose_yaml, from_mapping
from phihp_torchrl.trainers import read_request


@pytest.mark.slow
def test_the_script_runs_a_grid_shows_it_and_skips_it(
    run_script: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quoted = ",".join(f'"{override}"' for override in TINY)
    arguments = (
        "task=pendulum,cartpole",
        "share=0.04",
        "refresh=0",
        "allow_dirty=true",
        f"overrides=[{quoted}]",
    )
    run_script("run_grid", *arguments)
    shown = capsys.readouterr().out
    assert "2 cells: 2 done" in shown
    assert "phihp   cartpole  200      default  done" in shown
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.json")}
    assert len(kept) == 2 * 4 + 1
    names = ["cartpole-default-n200-seed0", "pendulum-default-n80-seed0"]
    planned = tmp_path / "results" / "trials" / "planned.json"
    assert [*json.loads(planned.read_text())] == names
    run_script("run_grid", *arguments)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.json")} == kept
    # One more cell, which fails, and the exit code says so.
    with pytest.raises(SystemExit) as error:
        run_script(
            "run_grid",
            "task=cartpole",
            "refresh=0.1",
            "allow_dirty=true",
            'overrides=["policy.gama=1"]',
        )
    assert error.value.code == 1
    shown = capsys.readouterr().out
    assert "cartpole-default-n2500-seed0 failed: " in shown
    assert "retry_failed=true" in shown
    every = sorted([*names, "cartpole-default-n2500-seed0"])
    assert [*json.loads(planned.read_text())] == every
    assert (planned.parent / "cartpole-default-n2500-seed0" / "failure.json").is_file()


def test_trials_are_kept_apart_from_the_cells_of_the_proof(tmp_path: Path) -> None:
    trial = GridConfig("phihp", "pendulum", 100)
    proof = replace(trial, proof=True)
    places = [config.files(tmp_path).results for config in (trial, proof)]
    assert places == [tmp_path / "results/trials", tmp_path / "results/runs"]
    assert replace(proof, results="here").files(tmp_path).results == tmp_path / "here"


def test_a_grid_may_be_planned_before_it_is_run(
    run_script: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_script("run_grid", "seed=4,5", "only_plan=true", "refresh=0", "allow_dirty=true")
    assert "2 cells: 2 waiting" in capsys.readouterr().out
    planned = json.loads((tmp_path / "results" / "trials" / "planned.json").read_text())
    assert [cell["seed"] for cell in planned.values()] == [4, 5]
    assert not list((tmp_path / "results" / "trials").glob("*/"))
    assert not list((tmp_path / "outputs").rglob("config.yaml"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["method=phihp,td5"], "method: expected one of"),
        (["seed=0,-1"], "seed: expected 0 to"),
        (["share=0"], "share: expected a positive number or null"),
        (["task=my-task"], "share: expected null for 'my-task'"),
        (["label=a/b"], "label: expected letters"),
        (["jobs=0"], "jobs: expected a whole number >= 1"),
        (["+sead=0"], "sead: unknown key; did you mean 'seed'"),
    ],
)
def test_a_wrong_grid_is_one_sentence_and_no_run(
    run_script: Callable[..., None], tmp_path: Path, arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit, match=f"^error: {message}"):
        run_script("run_grid", *arguments)
    assert not (tmp_path / "outputs").exists()


def test_code_without_a_commit_is_refused_before_anything_is_planned(
    run_script: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("grid.committed.ask_git", lambda *_: None)
    with pytest.raises(SystemExit, match=r"^error: allow_dirty: expected "):
        run_script("run_grid", "task=pendulum")
    assert not (tmp_path / "outputs").exists()
    assert not (tmp_path / "results").exists()


def test_an_earlier_plan_that_cannot_be_read_is_one_sentence_and_no_run(
    run_script: Callable[..., None], tmp_path: Path
) -> None:
    planned = tmp_path / "results" / "trials" / "planned.json"
    planned.parent.mkdir(parents=True)
    planned.write_text('["pendulum-default-n1000-seed0"]')
    with pytest.raises(SystemExit, match=r"^error: results: expected a description of each cell"):
        run_script("run_grid", "task=pendulum", "allow_dirty=true")
    assert not [*(tmp_path / "outputs" / "grid").glob("*/")]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["pendulum", "acrobot-swingup"])
def test_every_method_composes(method: str, task: str) -> None:
    keys = {key: value for key, value in YAML.items() if key not in ("defaults", "hydra")}
    config = from_mapping(GridConfig, {**keys, "method": method, "task": task, "seed": 1})
    words = config.words()
    made = read_request(compose_yaml(words), words).config
    assert (made.method, made.task, made.seed) == (method, task, 1)
    samples = config.cell().samples
    assert (samples is None) == (METHODS[method].samples_key is None)
    if samples is not None:
        assert made.section("model").real_steps == samples
    if method == "td3":  # the grid's own choice
        assert made.section("td3").real_steps == 300_000


@pytest.mark.parametrize("launcher", ["basic", "joblib", "ray", "submitit"])
def test_every_launcher_composes(launcher: str) -> None:
    plugin = f"hydra_plugins.hydra_{launcher}_launcher"
    if launcher != "basic" and (find_spec("hydra_plugins") is None or find_spec(plugin) is None):
        pytest.skip(f"hydra-{launcher}-launcher is not installed")
    with initialize_config_dir(str(PAPER / "config"), version_base="1.3"):
        made = compose("grid", [f"launcher={launcher}"], return_hydra_config=True)
    assert launcher in made.hydra.launcher._target_.lower() or launcher == "submitit"
    assert made.hydra.mode.name == "MULTIRUN"


@pytest.mark.slow
def test_processes_of_one_machine(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    quoted = ",".join(f'"{override}"' for override in TINY)
    command = [sys.executable, str(PAPER / "run_grid.py"), "launcher=joblib", "jobs=2"]
    command += [
        "task=pendulum",
        "seed=0,1",
        "share=0.03",
        "allow_dirty=true",
        f"overrides=[{quoted}]",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert "2 cells: 2 done" in done.stdout, done.stderr
