"""An offline run of wandb that crashed and went on is whole, by wandb's own client and files."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from phihp_torchrl.trainers import LoggerConfig, make_logger


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


@pytest.mark.slow  # the client has a service of its own to start
def test_the_folder_of_a_resumed_run_has_the_whole_run(tmp_path: Path) -> None:
    """Whatever the folder of the killed session holds, which may be a few bytes."""
    pytest.importorskip("wandb")
    rows = [
        {"phase": "model", "unit": str(k), "real_steps": str(30 * k), "loss": "0.5"}
        for k in range(2)
    ]
    config = LoggerConfig("wandb", mode="offline")
    logger = make_logger(config, {"seed": 0}, tmp_path, run_id="abc12345", resume_unit=2, rows=rows)
    for unit in (2, 3):
        logger.log({"phase": "policy", "unit": unit, "real_steps": 60, "loss": 0.25}, unit)
    logger.close()
    assert logger.id == "abc12345"
    (path,) = (tmp_path / "wandb").glob("offline-run-*/*.wandb")
    deadline = time.monotonic() + 30.0  # the client's service may write after it has answered
    while not (found := history(path)) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert sorted(found) == [0, 1, 2, 3]
    assert [found[k]["real_steps"] for k in range(4)] == ["0", "30", "60", "60"]
    assert [float(found[k]["loss"]) for k in range(4)] == [0.5, 0.5, 0.25, 0.25]
    assert found[0]["phase"] == '"model"'
