"""Checkpoints come back as they were, or are refused by their path."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.checkpoint import CheckpointError, CheckpointRotation

from phihp_torchrl.trainers.checkpoints import (
    clear_rotation,
    load_latest,
    load_state,
    save_state,
)

from .run_parts import Crash, assert_equal

META = {"task": "pendulum"}


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    shared = torch.rand(3)
    state = {
        "tensors": [shared, shared, torch.rand(4, 4).T, torch.tensor(True), torch.zeros(0, 2)],
        "numbers": (1, 2.5, None, True, float("inf"), "text"),
        3: {"nested": {"deep": torch.arange(3)}},
    }
    save_state(tmp_path / "state", state, metadata=META)
    assert_equal(load_state(tmp_path / "state", metadata=META), state)
    assert not [p for p in tmp_path.rglob("*") if p.suffix in (".pt", ".pkl", ".pickle")]


def test_what_is_no_data_is_refused_at_saving(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="object"):
        save_state(tmp_path / "state", {"a": object()}, metadata=META)
    assert not list(tmp_path.iterdir())


def corruptions() -> dict[str, Any]:
    def manifest(path: Path, change: Any) -> None:
        content = json.loads((path / "manifest.json").read_text())
        change(content)
        (path / "manifest.json").write_text(json.dumps(content))

    def file(path: Path, name: str) -> Path:
        return next(path.rglob(name))

    def truncate(path: Path, name: str) -> None:
        data = file(path, name).read_bytes()
        file(path, name).write_bytes(data[: len(data) // 2])

    def flip(path: Path) -> None:
        data = bytearray(file(path, "tensors.safetensors").read_bytes())
        data[-1] ^= 1
        file(path, "tensors.safetensors").write_bytes(bytes(data))

    def outside(content: dict[str, Any]) -> None:
        content["components"]["state"]["path"] = "../../elsewhere"

    return {
        "tensors cut": lambda p: truncate(p, "tensors.safetensors"),
        "tensors flipped": flip,
        "tensors gone": lambda p: file(p, "tensors.safetensors").unlink(),
        "tree cut": lambda p: truncate(p, "tree.json"),
        "tree of nonsense": lambda p: file(p, "tree.json").write_text('{"tree": {"eval": "1"}}'),
        "manifest cut": lambda p: truncate(p, "manifest.json"),
        "manifest gone": lambda p: (p / "manifest.json").unlink(),
        "manifest of nonsense": lambda p: (p / "manifest.json").write_text("[]"),
        "path outside": lambda p: manifest(p, outside),
        "other version": lambda p: manifest(p, lambda c: c["metadata"].update(format=99)),
        "other task": lambda p: manifest(p, lambda c: c["metadata"].update(task="acrobot")),
    }


@pytest.mark.parametrize("name", corruptions())
def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    rotation = CheckpointRotation(tmp_path / "checkpoints", keep_last=2, prefix="unit")
    for step in range(3):
        save_state(rotation, {"x": torch.full((64,), float(step))}, metadata=META, step=step)
    newest = rotation.checkpoints()[-1]
    corruptions()[name](newest)
    with pytest.raises(CheckpointError, match=newest.name):
        load_state(newest, metadata=META)
    with caplog.at_level(logging.WARNING):
        step, state = load_latest(rotation, metadata=META)
    assert (step, state["x"][0]) == (1, 1.0)
    assert newest.name in caplog.text
    corruptions()[name](rotation.checkpoints()[-1])
    with pytest.raises(CheckpointError, match="000000000001"):
        load_latest(rotation, metadata=META)


def test_a_removal_that_is_cut_off_leaves_whole_checkpoints_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rotation = CheckpointRotation(tmp_path, keep_last=2, prefix="unit")
    for unit in (1, 2):
        save_state(rotation, {"unit": unit}, metadata=META, step=unit)

    def cut_off(path: Path, **_: Any) -> None:
        next(p for p in Path(path).rglob("*.json")).unlink()
        raise Crash

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", cut_off)
        with pytest.raises(Crash):
            clear_rotation(rotation)
    assert load_latest(rotation, metadata=META) is None
    clear_rotation(rotation)
    assert not list(tmp_path.iterdir())
