"""An offline run of wandb that crashed and went on is whole, by wandb's own client and files."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from forked import Forks

from phihp_torchrl.trainers import LoggerConfig, run

from .run_parts import rows
from .tally import tally_config


def records(path: Path) -> Iterator[bytes]:
    """The records of a log in wandb's format: blocks of 32 KiB with parts of records in them."""
    data, position, whole = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        if (left := 32768 - position % 32768) < 7:
            position += left
            continue
        kind = data[position + 6]
        length = int.from_bytes(data[position + 4 : position + 6], "little")
        part = data[position + 7 : position + 7 + length]
        position += 7 + length
        whole = part if kind in (1, 2) else whole + part
        if kind in (1, 4):
            yield whole


def history(path: Path) -> dict[int, dict[str, str]]:
    """What a sync would upload: the rows by step."""
    from wandb.proto.wandb_internal_pb2 import Record

    rows = {}
    for data in records(path):
        record = Record()
        record.ParseFromString(data)
        if record.HasField("history"):
            items = record.history.item
            row = {"/".join(i.nested_key) or i.key: i.value_json for i in items}
            rows[int(row.get("_step", record.history.step.num))] = row
    return rows


KILLED = """
import os, signal
from phihp_torchrl.trainers import LoggerConfig, run
from phihp_torchrl.trainers.run_loop import RunLoop
from trainers.tally import register_tally, tally_config

log_unit = RunLoop._log_unit

def killed(self, *arguments):
    log_unit(self, *arguments)
    if self.position.unit == 4:
        os.kill(os.getpid(), signal.SIGKILL)

RunLoop._log_unit = killed
register_tally()
run(tally_config(logger=LoggerConfig("wandb", mode="offline")), {path!r})
"""


@pytest.mark.slow  # the client has a service of its own to start, twice
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("tally")
def test_the_folder_of_a_killed_and_resumed_run_has_the_whole_run(
    tmp_path: Path, forks: Forks
) -> None:
    """Whatever the folder of the killed session holds, which may be a few bytes."""
    pytest.importorskip("wandb")
    place = tmp_path / "run"
    forks.start(KILLED.format(path=str(place)))
    assert forks.wait() == -signal.SIGKILL
    (killed,) = (place / "wandb").glob("offline-run-*/*.wandb")
    logger = LoggerConfig("wandb", mode="offline")
    assert run(tally_config(logger=logger), place, resume=True).finished
    (last,) = set((place / "wandb").glob("offline-run-*/*.wandb")) - {killed}
    assert last.name == killed.name, "one run, by its identifier"
    expected = rows(place)
    deadline = time.monotonic() + 30.0  # the client's service may write after it has answered
    while len(found := history(last)) < len(expected) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert sorted(found) == list(range(6))
    for unit, row in enumerate(expected):
        assert found[unit]["phase"] == f'"{row["phase"]}"'
        assert found[unit]["real_steps"] == row["real_steps"]
        assert float(found[unit]["tally/sum"]) == float(row["tally/sum"])
