"""Grids of runs: every cell once, whatever happens meanwhile."""

from __future__ import annotations

import csv
import json
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from test_recipes import RECIPES, SMALL, recipe

from phihp_torchrl.benchmark import (
    BenchmarkConfig,
    Cell,
    LiveTable,
    MethodConfig,
    Status,
    claim,
    grid,
    is_claimed,
    keep,
    look,
    work,
)
from phihp_torchrl.benchmark.grid import failures, summary, table
from phihp_torchrl.evaluation import read_curve
from phihp_torchrl.report import read_run
from phihp_torchrl.trainers import ConfigError, from_mapping, read_request

__all__ = ["recipe"]  # a fixture

CONFIG = RECIPES / "config"
YAML = yaml.safe_load((CONFIG / "benchmark" / "benchmark.yaml").read_text())
METHODS = {
    name: from_mapping(MethodConfig, how, f"methods.{name}")
    for name, how in YAML["methods"].items()
}
# The number of samples is the cell's.
TINY = (*(s for s in SMALL if "real_steps" not in s), "evaluate.video=false")


@pytest.fixture
def config(tmp_path: Path) -> BenchmarkConfig:
    """A cell that takes a second."""
    return BenchmarkConfig(
        method="phihp",
        task="pendulum",
        seed=0,
        share=0.03,
        overrides=TINY,
        runs=str(tmp_path / "runs"),
        results=str(tmp_path / "kept"),
        claim_wait=0.0,
        methods=METHODS,
    )


def do(config: BenchmarkConfig):
    return work(config, CONFIG, Path())


def words(config: BenchmarkConfig) -> list[str]:
    """What the log says happened to a cell, word by word."""
    lines = config.files(Path()).log.read_text().splitlines()
    return [line.rsplit(" ", 1)[1] for line in lines if " INFO phihp_torchrl.benchmark" in line]


def returns(config: BenchmarkConfig) -> dict[str, list[float]]:
    results = json.loads(config.files(Path()).evaluation.read_text())
    return {name: result["returns"] for name, result in results.items()}


def test_a_cell_is_run_once_and_what_is_small_is_kept(config: BenchmarkConfig) -> None:
    files = config.files(Path())
    assert look(files).status is Status.WAITING
    assert do(config).status is Status.DONE
    kept = {path.name for path in files.kept.iterdir()}
    assert kept == {
        "cell.json", "config.yaml", "curve.csv", "evaluation.json", "metadata.json", "metrics.csv",
        "prediction.json",
    }  # fmt: skip
    assert json.loads((files.kept / "cell.json").read_text())["samples"] == 60
    curve = read_curve(files.kept / "curve.csv")
    assert [point.acting for point in curve] == ["actor", "actor", "planner", "actor"]
    assert {point.real_steps for point in curve} == {60}
    assert curve[-1].updates == 8
    errors = json.loads((files.kept / "prediction.json").read_text())
    assert errors.keys() == {"reset_mean", "reset_median", "coverage_mean", "coverage_median"}

    before = files.evaluation.stat().st_mtime_ns
    assert do(config) == look(files)
    assert files.evaluation.stat().st_mtime_ns == before
    assert words(config) == ["started", "finished"]


@pytest.mark.parametrize(
    ("method", "settings", "acting", "samples", "points"),
    [
        (
            "td3",
            ("td3.real_steps=40", "td3.evaluation_interval=20", "td3.random_steps=20",
             "td3.evaluation_episodes=2", "td3.actor_hidden_sizes=[8]",
             "td3.critic_hidden_sizes=[8]"),
            "actor", 40, 2,
        ),
        (
            "dd-cem",
            (*(s for s in TINY if s.startswith("model.")), "planner.planning_horizon=2",
             "planner.num_candidates=8", "planner.top_k=2", "planner.replan_every=2"),
            "planner", 60, 0,
        ),
        (
            "cem-oracle",
            ("planner.planning_horizon=2", "planner.num_candidates=8", "planner.top_k=2",
             "planner.replan_every=2"),
            "planner", 0, 0,
        ),
    ],
)  # fmt: skip
def test_other_methods_leave_what_a_report_reads(
    config: BenchmarkConfig,
    method: str,
    settings: tuple[str, ...],
    acting: str,
    samples: int,
    points: int,
) -> None:
    common = tuple(s for s in TINY if s.startswith(("compile", "evaluate")))
    cell = replace(config, method=method, overrides=(*settings, *common))
    state = do(cell)
    assert state.status is Status.DONE, state
    run = read_run(cell.files(Path()).kept)
    assert (run.method, run.label, run.samples) == (method, "default", samples)
    assert run.acting.keys() == {acting}
    assert [point.acting for point in run.curve] == [acting] * (points + 1)
    assert [point.real_steps for point in run.curve[:points]] == [20, 40][:points]
    assert bool(run.prediction) == (method != "td3")
    assert "p50" in run.acting[acting].latency


def test_what_an_earlier_version_did_not_keep_is_added(config: BenchmarkConfig) -> None:
    do(config)
    files = config.files(Path())
    (files.kept / "curve.csv").unlink()
    (files.kept / "prediction.json").unlink()
    do(config)
    assert read_curve(files.kept / "curve.csv")
    assert (files.kept / "prediction.json").is_file()
    assert words(config) == ["started", "finished"]


def test_a_finished_run_that_was_not_kept_is_kept_and_not_run_again(
    config: BenchmarkConfig,
) -> None:
    do(config)
    files = config.files(Path())
    rows = (files.run / "metrics.csv").read_text()
    for path in files.kept.iterdir():
        path.unlink()
    assert do(config).status is Status.DONE
    assert (files.kept / "metrics.csv").read_text() == rows


def test_a_failed_cell_is_reported_and_run_again_on_request_alone(config: BenchmarkConfig) -> None:
    wrong = replace(config, overrides=(*TINY, "policy.batch_size=0"))
    state = do(wrong)
    assert state.status is Status.FAILED
    assert "batch_size: expected a positive number" in state.detail
    assert do(config) == state  # whatever its settings
    assert words(config) == []  # not even started
    files = config.files(Path())
    assert failures({files: state}) == [
        f"{files.cell.name} failed: {state.detail} (see {files.log})"
    ]
    assert do(replace(config, retry_failed=True)).status is Status.DONE
    assert not files.failure.exists()


def test_a_cell_goes_on_with_its_own_settings_alone(config: BenchmarkConfig) -> None:
    do(config)
    for path in config.files(Path()).kept.iterdir():
        path.unlink()
    state = do(replace(config, overrides=(*TINY, "policy.updates=16")))
    assert state.status is Status.FAILED
    assert "policy.updates: 16, not 8" in state.detail


def test_what_was_killed_before_its_first_file_starts_afresh(config: BenchmarkConfig) -> None:
    run = config.files(Path()).run
    run.mkdir(parents=True)
    (run / ".config.yaml.stage").write_text("task: pend")
    assert do(config).status is Status.DONE


def test_another_process_has_it(config: BenchmarkConfig) -> None:
    files = config.files(Path())
    with claim(files.lock) as ours:
        assert ours
        assert is_claimed(files.lock)
        assert do(config).status is Status.RUNNING
    assert not files.run.exists()
    assert not is_claimed(files.lock)


def test_a_claim_ends_with_its_process(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    code = (
        "import time; from pathlib import Path; from phihp_torchrl.benchmark.claim import claim\n"
        f"with claim(Path({str(lock)!r})): print('mine', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "mine\n"
        with claim(lock) as ours:
            assert not ours
        other.kill()
        with claim(lock, wait=30) as ours:
            assert ours


@pytest.mark.slow
def test_a_killed_cell_goes_on_and_ends_as_if_it_had_not_been(
    config: BenchmarkConfig, tmp_path: Path
) -> None:
    whole = replace(config, runs=str(tmp_path / "whole"), results=str(tmp_path / "whole_kept"))
    assert do(whole).status is Status.DONE
    # Long enough to be caught in the middle: a checkpoint after every unit, and slow evaluations.
    overrides = [*TINY, "checkpoint_interval=0"]
    quoted = ",".join(f'"{override}"' for override in overrides)
    command = [sys.executable, str(RECIPES / "benchmark.py"), "task=pendulum", "share=0.03"]
    command += [f"runs={config.runs}", f"results={config.results}", f"overrides=[{quoted}]"]
    metrics = config.files(Path()).run / "metrics.csv"
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and process.poll() is None:
            if metrics.exists() and len(metrics.read_text().splitlines()) > 2:
                break
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
    assert look(config.files(Path())).status is Status.STOPPED
    assert do(replace(config, claim_wait=10.0)).status is Status.DONE
    assert words(config) == ["started", "resumed", "finished"]
    assert returns(config) == returns(whole)
    with (config.files(Path()).kept / "metrics.csv").open() as file:
        units = [int(row["unit"]) for row in csv.DictReader(file)]
    assert units == list(range(len(units)))


@pytest.mark.slow
def test_the_recipe_runs_a_grid_shows_it_and_skips_it(
    recipe: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quoted = ",".join(f'"{override}"' for override in TINY)
    arguments = ("task=pendulum,cartpole", "share=0.03,0.04", "refresh=0", f"overrides=[{quoted}]")
    recipe("benchmark", *arguments)
    shown = capsys.readouterr().out
    assert "4 cells: 4 done" in shown
    assert "phihp   cartpole  200      default  done" in shown
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.json")}
    assert len(kept) == 4 * 4
    recipe("benchmark", *arguments)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.json")} == kept
    # One more cell, which fails, and the exit code says so.
    with pytest.raises(SystemExit) as error:
        recipe("benchmark", "task=cartpole", "refresh=0.1", 'overrides=["policy.gama=1"]')
    assert error.value.code == 1
    shown = capsys.readouterr().out
    assert "cartpole-default-n2500-seed0 failed: " in shown
    assert "retry_failed=true" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["method=phihp,td5"], "method: expected one of"),
        (["seed=0,-1"], "seed: expected 0 to"),
        (["share=0"], "share: expected a positive number or null"),
        (["task=my-task"], "share: expected null for 'my-task'"),
        (["label=a/b"], "label: expected letters"),
        (["jobs=0"], "jobs: expected a positive number"),
        (["+sead=0"], "sead: unknown key; did you mean 'seed'"),
    ],
)
def test_a_wrong_grid_is_one_sentence_and_no_run(
    recipe: Callable[..., None], tmp_path: Path, arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit, match=f"^error: {message}"):
        recipe("benchmark", *arguments)
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["pendulum", "acrobot-swingup"])
def test_every_method_composes(method: str, task: str) -> None:
    how = METHODS[method]
    lines = [f"task={task}", "seed=1", "progress=false", *how.overrides, *YAML["overrides"]]
    if how.samples_key is not None:
        lines.append(f"{how.samples_key}=500")
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        made = read_request(compose(how.recipe, lines), lines).config
    assert getattr(made, "method", "phihp") == method
    assert made.seed == 1


@pytest.mark.parametrize("launcher", ["basic", "joblib", "ray", "submitit"])
def test_every_launcher_composes(launcher: str) -> None:
    plugin = f"hydra_plugins.hydra_{launcher}_launcher"
    if launcher != "basic" and (find_spec("hydra_plugins") is None or find_spec(plugin) is None):
        pytest.skip(f"hydra-{launcher}-launcher is not installed")
    with initialize_config_dir(str(CONFIG / "benchmark"), version_base="1.3"):
        made = compose("benchmark", [f"launcher={launcher}"], return_hydra_config=True)
    assert launcher in made.hydra.launcher._target_.lower() or launcher == "submitit"
    assert made.hydra.mode.name == "MULTIRUN"


@pytest.mark.slow
def test_processes_of_one_machine(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    quoted = ",".join(f'"{override}"' for override in TINY)
    command = [sys.executable, str(RECIPES / "benchmark.py"), "launcher=joblib", "jobs=2"]
    command += ["task=pendulum", "seed=0,1", "share=0.03", f"overrides=[{quoted}]"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert "2 cells: 2 done" in done.stdout, done.stderr


def test_the_grid_is_the_product_in_the_launchers_order(tmp_path: Path) -> None:
    base = {key: value for key, value in YAML.items() if key not in ("defaults", "hydra")}
    overrides = ["task=pendulum,acrobot", "seed=range(2)", "share=1,null", "launcher=joblib"]
    with pytest.raises(ConfigError, match="launcher: unknown key"):
        grid({**base, "launcher": "joblib"}, overrides, tmp_path)
    names = [files.cell.name for files in grid(base, overrides, tmp_path)]
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


def test_the_table_has_a_row_for_each_setting(config: BenchmarkConfig) -> None:
    states = {}
    for seed in (0, 1):
        files = replace(config, seed=seed).files(Path())
        states[files] = look(files)
    assert table(states)[1:] == ["phihp   pendulum  60       default  waiting  waiting"]
    assert summary([*states.values()]) == "2 cells: 2 waiting"


def test_workers_get_a_table_that_shows_nothing() -> None:
    live = LiveTable()
    live._lines = 7
    assert pickle.loads(pickle.dumps(live))._lines == 0


def test_half_written_files_say_what_they_are(config: BenchmarkConfig) -> None:
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


def test_keeping_marks_the_cell_as_done_last(
    config: BenchmarkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    do(config)
    files = config.files(Path())
    for path in files.kept.iterdir():
        path.unlink()
    module = sys.modules[keep.__module__]
    monkeypatch.setattr(module, "write_curve", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        keep(files)
    assert not files.evaluation.exists()


def test_names_are_files() -> None:
    assert Cell("ph-cem", "acrobot", 3, 5000, "paper").name == "acrobot-ph-cem-paper-n5000-seed3"
    with pytest.raises(ValueError, match="label: expected letters"):
        Cell("phihp", "acrobot", 0, label="..")
