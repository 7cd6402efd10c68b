"""``phihp train`` on the command line: mappings, sweeps, and runs that were stopped."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from phihp_torchrl.commands import job
from phihp_torchrl.config import parse_overrides
from phihp_torchrl.trainers import RunResult

from .command_parts import FAST
from .conftest import Command

MODEL = ("task=pendulum", "phases=[model]", *FAST)


def test_a_mapping_may_be_given_in_one_word(phihp: Command, place: Path) -> None:
    phihp("train", *MODEL, "run_dir=run", "world.friction={joint:0.25}")
    kept = yaml.safe_load((place / "run" / "config.yaml").read_text())
    assert kept["world"]["friction"] == {"joint": 0.25}
    with pytest.raises(SystemExit, match=r"^error: .*friction"):
        phihp("train", *MODEL, "run_dir=other", "world.friction={hinge:0.25}")


def test_a_sweep_is_a_run_for_each_value(phihp: Command, place: Path) -> None:
    phihp("train", "--multirun", *MODEL, "seed=0,1")
    runs = sorted((place / "outputs" / "pendulum").iterdir())
    seeds = [yaml.safe_load((run / "config.yaml").read_text())["seed"] for run in runs]
    assert sorted(seeds) == [0, 1]
    assert all((run / "metrics.csv").is_file() for run in runs)


@pytest.mark.parametrize("key", ["run_dir", "resume"])
def test_a_sweep_in_one_folder_is_refused_before_its_first_run(
    phihp: Command, place: Path, key: str
) -> None:
    with pytest.raises(SystemExit, match=rf"^error: {key}: expected a folder for each .* seed, .*"):
        phihp("train", "-m", *MODEL, "seed=0,1", f"{key}=mine")
    assert not list(place.iterdir())


def test_a_sweep_over_folders_may_name_them(phihp: Command, place: Path) -> None:
    phihp("train", "-m", *MODEL, "run_dir=runs/one,runs/two")
    phihp("train", "-m", *MODEL, "seed=3,4", "run_dir=runs/seed-${seed}")
    found = sorted(path.parent.name for path in (place / "runs").glob("*/report.html"))
    assert found == ["one", "seed-3", "seed-4", "two"]


@pytest.mark.slow  # two processes of their own, which import torch
@pytest.mark.timeout(300)
def test_runs_beside_each_other_in_one_folder_lose_nothing(place: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = ["task=pendulum", "seed=0,1", "phases=[model]", *FAST]
    command = [sys.executable, "-m", "phihp_torchrl", "train", "-m", "hydra/launcher=joblib"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([*command, "hydra.launcher.n_jobs=2", *words], env=environment, check=True)
    runs = list((place / "outputs" / "pendulum").iterdir())
    kept = [yaml.safe_load((run / "config.yaml").read_text()) for run in runs]
    assert sorted(settings["seed"] for settings in kept) == [0, 1]
    assert [len((run / "metrics.csv").read_text().splitlines()) for run in runs] == [3, 3]
    assert all((run / "report.html").is_file() for run in runs)


def test_flags_may_stand_between_settings(phihp: Command, place: Path) -> None:
    (place / "mine").mkdir()
    phihp("train", *MODEL, "--config-dir", "mine", "run_dir=run", "seed=3")
    kept = yaml.safe_load((place / "run" / "config.yaml").read_text())
    assert kept["seed"] == 3
    assert (place / "run" / "report.html").is_file()  # it composes the defaults, in Hydra's job


def test_a_stopped_run_says_how_to_go_on(
    phihp: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: Any, **__: Any) -> RunResult:
        return RunResult(Path("my runs/one"), False, signal.SIGTERM, {})

    monkeypatch.setattr(job, "run", stopped)
    monkeypatch.setattr("atexit.register", lambda *_: None)  # this process goes on
    with pytest.raises(SystemExit) as error:
        phihp("train", *MODEL)
    assert error.value.code == 128 + signal.SIGTERM
    told = capsys.readouterr().out.split("Go on with: ")[1]
    *command, word = shlex.split(told)  # as a shell reads it
    (line,) = parse_overrides([word])
    assert (command[-1], line.key_or_group) == ("train", "resume")
    assert str(line.value()) == "my runs/one"


def test_an_error_of_the_system_is_one_line_with_a_path(
    phihp: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> RunResult:
        raise OSError(28, "No space left on device", "my run/metrics.csv")

    monkeypatch.setattr(job, "run", full)
    with pytest.raises(
        SystemExit, match=r"^error: my run/metrics.csv: No space left on device\. Make room"
    ):
        phihp("train", *MODEL)


@pytest.mark.parametrize("words", [["mode=paper"], ["-x", "policy.updates=0"]])
def test_what_is_wrong_is_no_run(phihp: Command, place: Path, words: list[str]) -> None:
    with pytest.raises(SystemExit) as error:
        phihp("train", *MODEL, *words)
    assert error.value.code
    assert not (place / "outputs").exists()


def test_the_first_line_comes_before_torch_is_loaded(place: Path) -> None:
    code = """
import sys
sys.modules["torch"] = None  # importing it fails
from phihp_torchrl.commands import main
main(["train", "task=pendulum", "run_dir=run"])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=place, check=False
    )
    first, *_, last = (done.stdout + done.stderr).splitlines()
    assert first.startswith("phihp train: loading PyTorch")
    assert done.returncode != 0
    assert "torch" in last
