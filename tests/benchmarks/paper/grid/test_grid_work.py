"""Cells of a grid: each once, whatever happens meanwhile."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from forked import Forks
from grid_cells import PAPER, TINY, do, returns, words

from grid import GridConfig, Status, claim, is_claimed, keep, look
from grid.display import failures
from measures import read_curve
from phihp_torchrl.config import ConfigError
from report import read_run

BRIEF_SCRIPT = """
import os, runpy, sys
from pytest import MonkeyPatch
from brief import shorten
shorten(MonkeyPatch())
os.chdir({place!r})
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
sys.argv = {words!r}
sys.path.insert(0, sys.argv[0].rpartition("/")[0])
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""A script in a process whose episodes are as short as in these tests."""


def test_a_cell_is_run_once_and_what_is_small_is_kept(config: GridConfig) -> None:
    files = config.files(Path())
    assert look(files).status is Status.WAITING
    assert do(config).status is Status.DONE
    kept = {path.name for path in files.kept.iterdir()}
    assert kept == {
        "cell.json", "config.yaml", "curve.csv", "evaluation.json", "metadata.json", "metrics.csv",
        "prediction.json",
    }  # fmt: skip
    cell = json.loads((files.kept / "cell.json").read_text())
    assert (cell["samples"], cell["proof"]) == (60, False)
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
    config: GridConfig,
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


def of_other_settings(config: GridConfig) -> None:
    """Let a finished cell and its run be of another default, which the words do not name."""
    files = config.files(Path())
    for folder in (files.run, files.kept):
        text = (folder / "config.yaml").read_text()
        assert "patience: 0.4\n" in text
        (folder / "config.yaml").write_text(text.replace("patience: 0.4\n", "patience: 0.5\n"))


def test_a_finished_cell_of_other_settings_is_refused(finished: GridConfig) -> None:
    files = finished.files(Path())
    before = files.evaluation.read_bytes()
    assert do(finished).status is Status.DONE  # the same
    of_other_settings(finished)
    shutil.rmtree(files.run / "phases")  # what takes room
    shutil.rmtree(files.run / "checkpoints")
    with pytest.raises(ConfigError, match="run of the present settings") as caught:
        do(finished)
    assert str(files.kept) in str(caught.value)
    assert files.evaluation.read_bytes() == before
    assert (files.run / "agent").is_dir()


def test_a_run_of_other_settings_is_not_kept_as_a_cell(
    finished: GridConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("grid.worker.configuration_hash", lambda settings: "another default")
    elsewhere = replace(finished, results=str(tmp_path / "elsewhere"))
    state = do(elsewhere)
    assert state.status is Status.FAILED
    assert "run of the present settings" in state.detail
    assert not elsewhere.files(Path()).evaluation.exists()


def test_what_an_earlier_version_did_not_keep_is_added(finished: GridConfig) -> None:
    files = finished.files(Path())
    (files.kept / "curve.csv").unlink()
    (files.kept / "prediction.json").unlink()
    do(finished)
    assert read_curve(files.kept / "curve.csv")
    assert (files.kept / "prediction.json").is_file()
    assert words(finished) == ["started", "finished"]


def test_a_finished_run_that_was_not_kept_is_kept_and_not_run_again(
    finished: GridConfig,
) -> None:
    files = finished.files(Path())
    rows = (files.run / "metrics.csv").read_text()
    for path in files.kept.iterdir():
        path.unlink()
    assert do(finished).status is Status.DONE
    assert (files.kept / "metrics.csv").read_text() == rows


def test_keeping_marks_the_cell_as_done_last(
    finished: GridConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = finished.files(Path())
    for path in files.kept.iterdir():
        path.unlink()
    module = sys.modules[keep.__module__]
    monkeypatch.setattr(module, "write_curve", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        keep(files)
    assert not files.evaluation.exists()


def test_a_failed_cell_is_reported_and_run_again_on_request_alone(config: GridConfig) -> None:
    wrong = replace(config, overrides=(*TINY, "policy.batch_size=0"))
    state = do(wrong)
    assert state.status is Status.FAILED
    assert "policy.batch_size: expected a whole number >= 1" in state.detail
    assert do(config) == state  # whatever its settings
    assert words(config) == []  # not even started
    files = config.files(Path())
    assert failures({files: state}) == [
        f"{files.cell.name} failed: {state.detail} (see {files.log})"
    ]
    kept = json.loads((files.kept / "failure.json").read_text())
    assert kept.keys() == {"error", "when", "commit"}
    assert kept["error"] == state.detail
    assert do(replace(config, retry_failed=True)).status is Status.DONE
    assert not files.failure.exists()
    assert not (files.kept / "failure.json").exists()


def test_a_cell_goes_on_with_its_own_settings_alone(finished: GridConfig) -> None:
    for path in finished.files(Path()).kept.iterdir():
        path.unlink()
    state = do(replace(finished, overrides=(*TINY, "policy.updates=16")))
    assert state.status is Status.FAILED
    assert "policy.updates: 16, not 8" in state.detail


def test_what_was_killed_before_its_first_file_starts_afresh(config: GridConfig) -> None:
    run = config.files(Path()).run
    run.mkdir(parents=True)
    (run / ".config.yaml.stage").write_text("task: pend")
    assert do(config).status is Status.DONE


def test_another_process_has_it(config: GridConfig) -> None:
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
        "import time; from pathlib import Path; from claim import claim\n"  # without torch
        f"with claim(Path({str(lock)!r})): print('mine', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=PAPER / "grid", stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "mine\n"
        with claim(lock) as ours:
            assert not ours
        other.kill()
        with claim(lock, wait=30) as ours:
            assert ours


@pytest.mark.slow
def test_a_killed_cell_goes_on_and_ends_as_if_it_had_not_been(
    config: GridConfig, whole: GridConfig, tmp_path: Path, forks: Forks
) -> None:
    # Long enough to be caught in the middle: a checkpoint after every unit, and slow evaluations.
    overrides = [*TINY, "checkpoint_interval=0"]
    quoted = ",".join(f'"{override}"' for override in overrides)
    command = [
        str(PAPER / "run_grid.py"),
        "task=pendulum",
        "share=0.03",
        "allow_dirty=true",
    ]
    command += [f"runs={config.runs}", f"results={config.results}", f"overrides=[{quoted}]"]
    metrics = config.files(Path()).run / "metrics.csv"
    process = forks.start(BRIEF_SCRIPT.format(place=str(tmp_path), words=command))
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if metrics.exists() and len(metrics.read_text().splitlines()) > 2:
            break
        time.sleep(0.001)
    os.kill(process, signal.SIGKILL)
    assert forks.wait() == -signal.SIGKILL
    assert look(config.files(Path())).status is Status.STOPPED
    again = replace(config, claim_wait=10.0, overrides=tuple(overrides))
    assert do(again).status is Status.DONE
    assert words(config) == ["started", "resumed", "finished"]
    assert returns(config) == returns(whole)
    with (config.files(Path()).kept / "metrics.csv").open() as file:
        units = [int(row["unit"]) for row in csv.DictReader(file)]
    assert units == list(range(len(units)))


def test_a_cell_that_failed_at_its_start_can_be_corrected(
    config: GridConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its settings are on disk already, and nothing else is."""
    module = sys.modules["phihp_torchrl.trainers.run_loop"]
    with monkeypatch.context() as patch:
        patch.setattr(module.RunLoop, "_make_phase", lambda *_: 1 / 0)
        assert do(config).status is Status.FAILED
    files = config.files(Path())
    assert (files.run / "config.yaml").is_file()
    corrected = replace(config, overrides=(*TINY, "policy.updates=16"), retry_failed=True)
    assert do(corrected).status is Status.DONE
    assert "updates: 16" in (files.kept / "config.yaml").read_text()


@pytest.mark.parametrize("also_in_full", [False, True])
def test_a_torn_evaluation_is_not_done(finished: GridConfig, also_in_full: bool) -> None:
    files = finished.files(Path())
    text = files.evaluation.read_text()
    for path in (files.evaluation, *([files.run / "evaluation.json"] if also_in_full else [])):
        path.write_text(text[: len(text) // 2])
    assert look(files).status is not Status.DONE
    assert do(finished).status is Status.DONE
    assert files.evaluation.read_text() == text
