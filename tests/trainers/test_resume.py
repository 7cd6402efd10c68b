"""Runs that were killed, crashed or asked to stop go on as if nothing had happened."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from forked import Forks
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.trainers import run
from phihp_torchrl.trainers.checkpoints import load_state, save_state
from phihp_torchrl.trainers.interrupt import Interrupt
from phihp_torchrl.trainers.run_loop import RunLoop

from .run_parts import CONFIG, UNITS, Crash, assert_same_run, rows

KILLS = {
    "model: after its row, before its checkpoint": (1, "_log_unit"),
    "policy: after its row, before its checkpoint": (4, "_log_unit"),
    "evaluate: after its last checkpoint, before it is finished": (UNITS, "_save"),
}
"""The unit at which a run is killed, and the method of a run after which."""

KILLED = """
import os, signal
from phihp_torchrl.trainers import run
from phihp_torchrl.trainers.run_loop import RunLoop
from trainers.run_parts import CONFIG

method = getattr(RunLoop, {name!r})

def killed(self, *arguments):
    method(self, *arguments)
    if self.position.unit == {unit}:
        os.kill(os.getpid(), signal.SIGKILL)

setattr(RunLoop, {name!r}, killed)
run(CONFIG, {path!r})
"""


@pytest.mark.parametrize("where", KILLS)
def test_a_killed_run_goes_on_as_if_nothing_had_happened(
    whole: Path, tmp_path: Path, forks: Forks, where: str
) -> None:
    path, (unit, name) = tmp_path / "run", KILLS[where]
    forks.start(KILLED.format(unit=unit, name=name, path=str(path)))
    assert forks.wait() == -signal.SIGKILL
    torch.rand(7)  # the process that resumes has a past of its own
    assert run(CONFIG, path, resume=True).finished
    assert_same_run(path, whole)


@pytest.mark.parametrize("unit", [0, 3, UNITS - 1])
def test_a_crash_loses_nothing(
    whole: Path, tmp_path: Path, unit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_unit = RunLoop._log_unit

    def crash(self: Any, *arguments: Any) -> None:
        log_unit(self, *arguments)
        if self.position.unit == unit:
            raise Crash

    monkeypatch.setattr(RunLoop, "_log_unit", crash)
    with pytest.raises(Crash):
        run(CONFIG, tmp_path / "run")
    monkeypatch.undo()
    assert run(CONFIG, tmp_path / "run", resume=True).finished
    assert_same_run(tmp_path / "run", whole)


def test_a_signal_ends_a_run_after_the_unit_and_its_checkpoint(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    number = signal.SIGTERM
    log_unit = RunLoop._log_unit

    def interrupt(self: Any, *arguments: Any) -> None:
        if self.position.unit == 3:
            os.kill(os.getpid(), number)
        log_unit(self, *arguments)

    monkeypatch.setattr(RunLoop, "_log_unit", interrupt)
    rarely = replace(CONFIG, checkpoint_interval=1000.0)
    result = run(rarely, tmp_path / "run")
    monkeypatch.undo()
    assert (result.finished, result.signal) == (False, number)
    assert len(rows(tmp_path / "run")) == 4
    resumed = run(CONFIG, tmp_path / "run", resume=True)  # the interval may change
    assert (resumed.finished, resumed.signal) == (True, None)
    assert_same_run(tmp_path / "run", whole)


def test_the_second_signal_stops_at_once() -> None:
    before = signal.getsignal(signal.SIGINT)  # a job in the background ignores it
    with Interrupt() as interrupt:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_survives_a_damaged_checkpoint(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = RunLoop._save

    def crash(self: Any, *arguments: Any) -> None:
        save(self, *arguments)
        if self.position.unit == 4:
            raise Crash

    monkeypatch.setattr(RunLoop, "_save", crash)
    with pytest.raises(Crash):
        run(CONFIG, tmp_path / "run")
    monkeypatch.undo()
    newest = sorted((tmp_path / "run" / "checkpoints").iterdir())[-1]
    next(newest.rglob("tensors.safetensors")).write_bytes(b"")
    assert run(CONFIG, tmp_path / "run", resume=True).finished
    assert_same_run(tmp_path / "run", whole)


def test_a_hostile_final_state_is_refused(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    run(replace(CONFIG, phases=("model",)), path)
    state = load_state(path / "phases" / "model", metadata={"task": CONFIG.task})
    state["trainer"]["dynamics"] = {"residual.0.weight": torch.zeros(1)}
    save_state(path / "phases" / "model", state, metadata={"task": CONFIG.task})
    with pytest.raises(CheckpointError, match="does not fit"):
        run(replace(CONFIG, phases=("model",)), path, resume=True)
