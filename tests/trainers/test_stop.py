"""A stop does not wait for a long unit of work, and costs nothing but that unit."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from forked import Forks

from phihp_torchrl.trainers import ModelTrainer, PolicyTrainer, run
from phihp_torchrl.trainers.evaluate import EvaluatePhase
from phihp_torchrl.trainers.interrupt import Abandoned, Interrupt
from phihp_torchrl.trainers.keeper import Keeper

from .run_parts import CONFIG, assert_same_run, rows, run_module

RARELY = replace(CONFIG, checkpoint_interval=1000.0)
LONG = """
import time
from dataclasses import replace
from phihp_torchrl.commands import tell
from phihp_torchrl.trainers import PolicyTrainer, run
from trainers.run_parts import CONFIG

advance = PolicyTrainer.advance

def long(self):
    metrics = advance(self)  # half a unit, of which nothing may be left
    if self.updates == 8:
        print("now", flush=True)
        for _ in range(600):
            time.sleep(0.1)
    return metrics

PolicyTrainer.advance = long
tell(run(replace(CONFIG, checkpoint_interval=1000.0), {path!r}))  # as the console does
"""


def hang(number: int) -> None:
    """What a unit does when it is asked to stop: it goes on for a minute."""
    os.kill(os.getpid(), number)
    time.sleep(60.0)
    raise AssertionError("the unit was not given up")


@pytest.mark.parametrize(
    ("owner", "method", "call", "done"),
    [
        pytest.param(ModelTrainer, "_collect", 0, 0, id="before anything is saved"),
        pytest.param(ModelTrainer, "fit", 1, 1, id="in a fit, whose real steps are saved"),
        pytest.param(PolicyTrainer, "advance", 1, 3, id="in training, after it changed weights"),
        pytest.param(EvaluatePhase, "_evaluate", 1, 6, id="in an evaluation"),
    ],
)
def test_a_unit_is_given_up_and_done_again(
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    owner: type,
    method: str,
    call: int,
    done: int,
) -> None:
    work: Callable[..., Any] = getattr(owner, method)
    calls = 0

    def slow(self: Any, *arguments: Any) -> Any:
        nonlocal calls
        found = work(self, *arguments)
        if calls == call:
            hang(signal.SIGTERM)
        calls += 1
        return found

    monkeypatch.setattr(owner, method, slow)
    monkeypatch.setattr(run_module, "Interrupt", partial(Interrupt, grace=0.1))
    monkeypatch.setattr("phihp_torchrl.trainers.keeper._SHARE", float("inf"))  # before every unit
    result = run(RARELY, tmp_path / "run")
    assert (result.finished, result.signal) == (False, signal.SIGTERM)
    assert len(rows(tmp_path / "run")) == done
    monkeypatch.undo()
    torch.rand(7)
    if method == "fit":  # no real step is taken a second time
        monkeypatch.setattr(ModelTrainer, "_collect", None)
    assert run(CONFIG, tmp_path / "run", resume=True).finished
    assert_same_run(tmp_path / "run", whole)


def test_a_state_that_is_dear_to_keep_is_not_kept_before_every_unit(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    advance, calls = PolicyTrainer.advance, 0

    def slow(self: PolicyTrainer) -> dict[str, float]:
        nonlocal calls
        calls += 1
        if calls == 3:
            hang(signal.SIGINT)
        return advance(self)

    monkeypatch.setattr(PolicyTrainer, "advance", slow)
    monkeypatch.setattr(run_module, "Interrupt", partial(Interrupt, grace=0.1))
    monkeypatch.setattr("phihp_torchrl.trainers.keeper._SHARE", 1e-9)
    assert not run(RARELY, tmp_path / "run").finished
    monkeypatch.undo()
    assert run(CONFIG, tmp_path / "run", resume=True).finished
    assert_same_run(tmp_path / "run", whole)


def test_a_save_is_not_cut() -> None:
    with Interrupt(grace=0.05) as interrupt, interrupt.work():
        with interrupt.whole():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.3)
        with pytest.raises(Abandoned):
            time.sleep(10.0)


def test_a_stop_that_a_library_swallows_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phihp_torchrl.trainers.interrupt._AGAIN", 0.1)
    with Interrupt(grace=0.05) as interrupt, interrupt.work():
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(2):
            with pytest.raises(Abandoned):
                time.sleep(10.0)


def test_handlers_are_as_before() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = [signal.getsignal(number) for number in numbers]
    with Interrupt(grace=0.05) as interrupt:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)  # outside of work, nothing is given up
        assert interrupt
    assert [signal.getsignal(number) for number in numbers] == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_nothing_in_memory_is_saved_over_something_later(tmp_path: Path) -> None:
    from torchrl.checkpoint import CheckpointRotation

    from phihp_torchrl.trainers.checkpoints import load_latest

    rotation = CheckpointRotation(tmp_path, keep_last=2, prefix="unit")
    keeper = Keeper(rotation, {"task": "x"}, Interrupt())
    keeper.freeze(lambda: {"value": 1}, unit=0)
    keeper.save({"value": 2}, unit=0)  # as new real steps are saved within a unit
    keeper.save_frozen()
    found = load_latest(rotation, metadata={"task": "x"})
    assert found == (0, {"value": 2})


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_process_ends_within_ten_seconds(
    whole: Path, tmp_path: Path, forks: Forks, number: int
) -> None:
    path = tmp_path / "run"
    process = forks.start(LONG.format(path=str(path)))
    assert forks.line() == "now"
    start = time.monotonic()
    os.kill(process, number)
    assert forks.wait() == 128 + number
    assert time.monotonic() - start < 10.0
    assert len(rows(path)) == 3
    assert run(CONFIG, path, resume=True).finished
    assert_same_run(path, whole)
