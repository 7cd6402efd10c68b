"""Two processes never work on one run; what a killed one leaves behind locks nothing."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import run
from phihp_torchrl.trainers.lock import LOCK, OWNER, RunLock, owner
from phihp_torchrl.trainers.run_directory import RunDirectory

from .tally import final_states, tally_config

pytestmark = pytest.mark.usefixtures("tally")

# Without the package, whose import takes seconds: what a process with the lock has on disk.
HOLDER = """
import json, sys, time
from filelock import FileLock
lock = FileLock(sys.argv[1] + "/.lock")
lock.acquire(timeout=0)
json.dump({"pid": 4711, "host": "the-cluster", "since": "noon"}, open(sys.argv[1] + "/.owner.json", "w"))
print("locked", flush=True)
time.sleep(60)
"""  # noqa: E501


def held(place: Path) -> subprocess.Popen[str]:
    """A process that holds the lock of a run."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(place)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    return process


def test_a_second_process_is_refused_and_harms_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "run"
    run(tally_config(), place)
    before = {p: p.read_bytes() for p in place.rglob("*") if p.is_file()}
    process = held(place)
    try:
        with pytest.raises(ConfigError, match=r"process 4711 on host 'the-cluster', since noon"):
            run(tally_config(), place, resume=True)
        with pytest.raises(ConfigError, match=r"process 4711 on host 'the-cluster', since noon"):
            run(tally_config(), place)  # which it holds already is not the point
        (place / OWNER).unlink()
        assert {p: p.read_bytes() for p in place.rglob("*") if p.is_file()} == before
        with pytest.raises(ConfigError, match="not yet given its name"):
            run(tally_config(), place, resume=True)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    # Killed, it cannot give the lock up; the system does, and what it wrote is stale.
    (place / OWNER).write_text(json.dumps({"pid": 4711, "host": "the-cluster", "since": "noon"}))
    with pytest.raises(ConfigError, match="holds a run already; go on with"):
        run(tally_config(), place)
    with caplog.at_level(logging.WARNING):
        assert run(tally_config(), place, resume=True).finished
    assert "process 4711 on host 'the-cluster', since noon had" in caplog.text
    assert not (place / OWNER).exists()


def test_two_that_start_in_one_directory(tmp_path: Path) -> None:
    place = tmp_path / "run"
    place.mkdir()
    with RunLock(place):
        assert owner(place)["pid"] == os.getpid()
        with pytest.raises(ConfigError, match=f"process {os.getpid()} on host"):
            run(tally_config(), place)
        assert {path.name for path in place.iterdir()} == {LOCK, OWNER}
    assert run(tally_config(), place).finished
    assert len(final_states(place)) == 2


def test_a_start_that_was_cut_off_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "write_config", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run(tally_config(), tmp_path / "run")
    (tmp_path / "run" / ".config.yaml.0123.stage").write_text("task: pend")
    assert run(tally_config(), tmp_path / "run").finished
    assert not list((tmp_path / "run").glob(".*.stage"))


@pytest.mark.parametrize("alive", [True, False])
def test_where_there_are_no_locks_the_owner_is_asked_for(
    alive: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def none(*_: object, **__: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(FileLock, "acquire", none)
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    pid = os.getpid() if alive else dead.pid
    (tmp_path / OWNER).write_text(json.dumps({"pid": pid, "host": socket.gethostname()}))
    if alive:
        with pytest.raises(ConfigError, match=f"process {pid} on host"), RunLock(tmp_path):
            pass
    else:
        with caplog.at_level(logging.WARNING), RunLock(tmp_path):
            assert owner(tmp_path)["pid"] == os.getpid()
        assert "take care that no other process" in caplog.text


def test_a_directory_that_nobody_may_write_to_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(FileLock, "acquire", refuse)
    with pytest.raises(ConfigError, match=r"cannot be written to: .*Permission"), RunLock(tmp_path):
        pass
