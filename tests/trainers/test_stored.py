"""What a run has stored comes back as it was, is repaired, or is refused by name."""

from __future__ import annotations

import json
import logging
import random
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.config import ConfigError, sealed, unsealed
from phihp_torchrl.trainers import read_result, run
from phihp_torchrl.trainers.checkpoints import load_state, save_state
from phihp_torchrl.trainers.files import write_atomically
from phihp_torchrl.trainers.metrics_table import read_rows
from phihp_torchrl.trainers.run_directory import RunDirectory

from .run_parts import CONFIG, Crash, assert_same_run
from .tally import TASK, Tally, TallyConfig, final_states, tally_config

pytestmark = pytest.mark.usefixtures("tally")


@pytest.fixture
def stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that crashed in its second phase, after two checkpoints of that phase."""
    place = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(Tally, "fail_at", 2)
        with pytest.raises(Crash):
            run(tally_config(TallyConfig(units=1)), place)
    return place


def resume(place: Path) -> None:
    assert run(tally_config(TallyConfig(units=1)), place, resume=True).finished


def table(place: Path) -> list[dict[str, str]]:
    return [{k: v for k, v in row.items() if k != "seconds"} for row in read_rows(place)]


@pytest.mark.parametrize("harm", ["gone", "cut", "a digit", "no table", "finished"])
def test_a_table_that_is_not_what_was_written_is_noticed_and_restored(
    harm: str, stopped: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = stopped / "metrics.csv"
    if harm == "finished":
        resume(stopped)
    text = path.read_text()
    before = table(path)
    assert len(before) == (4 if harm == "finished" else 3)
    with caplog.at_level(logging.WARNING):
        if harm == "gone":
            path.unlink()
        elif harm in ("cut", "finished"):
            path.write_text(text[: text.rindex("\n", 0, len(text) - 1) + 1])
        elif harm == "a digit":
            found = re.search(r"\d(?=\n)", text)
            assert found is not None
            digit = str((int(found[0]) + 1) % 10)
            path.write_text(text[: found.start()] + digit + text[found.end() :])
        else:
            path.write_bytes(b"\xff\x00")
        resume(stopped)
    assert "metrics.csv is not what the run has written" in caplog.text
    assert table(path)[: len(before)] == before
    assert [row["unit"] for row in table(path)] == ["0", "1", "2", "3"]


def test_a_table_that_is_whole_is_no_reason_to_worry(
    stopped: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        resume(stopped)
        resume(stopped)
    assert caplog.text == ""


def test_settings_that_were_edited_are_named(stopped: Path) -> None:
    path = stopped / "config.yaml"
    text = path.read_text()
    path.write_text(text.replace("units: 1", "units: 2").replace("scale: 1.0", "scale: 3.0", 1))
    with pytest.raises(ConfigError, match=r"another configuration: tally-one\.units: 1, not 2"):
        resume(stopped)
    # Read from the folder, as a command line does, they agree with themselves.
    edited = tally_config(TallyConfig(units=2, scale=3.0))
    with pytest.raises(
        ConfigError,
        match=r"config\.yaml: was changed .*tally-one\.units: 2, not 1; tally-one\.scale: 3\.0",
    ):
        run(edited, stopped, resume=True)
    # Without what was noted at the start, the checkpoints know.
    (stopped / "metadata.json").unlink()
    with pytest.raises(CheckpointError, match="other settings than those in config"):
        run(edited, stopped, resume=True)
    path.write_text(text.replace("keep_checkpoints: 2", "keep_checkpoints: 3"))  # it may be
    resume(stopped)


@pytest.mark.parametrize("harm", ["gone", "cut", "edited"])
def test_metadata_that_are_damaged_block_nothing(
    harm: str, stopped: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = stopped / "metadata.json"
    if harm == "gone":
        path.unlink()
    elif harm == "cut":
        path.write_text(path.read_text()[:40])
    else:
        path.write_text(path.read_text().replace('"seed": 0', '"seed": 1'))
        with pytest.raises(ConfigError, match="damaged or edited"):
            RunDirectory(stopped).read_metadata()
    resume(stopped)
    assert "record of earlier sessions is lost" in caplog.text
    assert (stopped / "damaged-metadata.json").exists() == (harm != "gone")
    metadata = RunDirectory(stopped).read_metadata()
    assert metadata["seconds"].keys() == {"tally-one", "tally-two"}


@pytest.mark.parametrize("place", ["last", "last but one"])
def test_a_kill_before_the_metadata_of_a_phase_loses_nothing(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = RunDirectory.write_metadata

    def crash(self: RunDirectory, metadata: Any) -> None:
        done = metadata.get("seconds", {})
        if len(done) == (2 if place == "last" else 1):
            raise Crash
        written(self, metadata)

    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "write_metadata", crash)
        with pytest.raises(Crash):
            run(tally_config(), tmp_path / "run")
    assert run(tally_config(), tmp_path / "run", resume=True).finished
    metadata = RunDirectory(tmp_path / "run").read_metadata()
    assert metadata["seconds"].keys() == {"tally-one", "tally-two"}
    assert metadata["real_steps"] == 0


def test_the_newest_whole_checkpoint_is_used(
    stopped: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run(tally_config(TallyConfig(units=1)), tmp_path / "whole")
    newest = sorted((stopped / "checkpoints").glob("unit-*"))[-1]
    tree = next(newest.rglob("tree.json"))
    tree.write_text(tree.read_text().replace('"count", 2', '"count", 0'))
    resume(stopped)
    assert f"{newest.name}: not a usable checkpoint" in caplog.text
    assert "tree.json: damaged" in caplog.text
    assert final_states(stopped) == final_states(tmp_path / "whole")


def test_every_flipped_bit_is_noticed_or_changes_nothing(stopped: Path) -> None:
    """In each file of a checkpoint, and in the metadata, of which the digests are no exception."""
    state = stopped / "phases" / "tally-one"
    origin = {"task": TASK}
    good = repr(load_state(state, metadata=origin))
    known = unsealed((stopped / "metadata.json").read_text())
    draw = random.Random(0)
    refused = 0
    for path in [*(p for p in state.rglob("*") if p.is_file()), stopped / "metadata.json"]:
        data = path.read_bytes()
        for _ in range(40):
            changed = bytearray(data)
            changed[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            path.write_bytes(changed)
            try:
                if path.name == "metadata.json":
                    found = RunDirectory(stopped).read_metadata()
                    assert {k: v for k, v in found.items() if k in known} == known
                else:
                    assert repr(load_state(state, metadata=origin)) == good
            except (ConfigError, CheckpointError):
                refused += 1
        path.write_bytes(data)
    assert refused > 80


def test_checkpoints_of_the_version_before_are_read(stopped: Path) -> None:
    """They have no digest of their tree, and nothing of the table."""
    path = stopped / "phases" / "tally-one"
    state = load_state(path, metadata={"task": TASK})
    for key in ("rows", "settings"):
        del state[key]
    shutil.rmtree(path)
    shutil.rmtree(stopped / "checkpoints")
    save_state(path, state, metadata={"task": TASK})
    manifest = path / "manifest.json"
    content = json.loads(manifest.read_text())
    content["metadata"] = {"task": TASK, "format": 1}
    content["components"]["state"]["adapter_version"] = 1
    manifest.write_text(json.dumps(content))
    metadata = json.loads((stopped / "metadata.json").read_text())
    (stopped / "metadata.json").write_text(json.dumps({"sessions": metadata["sessions"]}))
    resume(stopped)
    assert [row["unit"] for row in table(stopped / "metrics.csv")] == ["0", "1", "2", "3"]


def test_a_run_from_another_has_its_own_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tally_config(), tmp_path / "first")
    later = tally_config(phases=("tally-two",), start_from=str(tmp_path / "first"))
    with monkeypatch.context() as patch:
        patch.setattr(Tally, "fail_at", 2)
        with pytest.raises(Crash):
            run(later, tmp_path / "later")
    assert run(later, tmp_path / "later", resume=True).finished
    assert [row["unit"] for row in table(tmp_path / "later" / "metrics.csv")] == ["3", "4", "5"]


def test_a_finished_run_mends_its_evaluation_and_its_agent(
    whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "run"
    shutil.copytree(whole, place)
    before = {p.name: p.read_bytes() for p in (place / "evaluation.json", *_agent(place))}
    (place / "evaluation.json").write_bytes(before["evaluation.json"][:50])
    with pytest.raises(ConfigError, match=r"evaluation\.json: .*resume="):
        read_result(place)
    edited = before["evaluation.json"].replace(b'"return_mean": -', b'"return_mean": -9', 1)
    (place / "evaluation.json").write_bytes(edited)
    with pytest.raises(ConfigError, match="its digest is another"):
        read_result(place)
    weights = bytearray(before["weights.safetensors"])
    weights[-1] ^= 1
    (place / "agent" / "weights.safetensors").write_bytes(weights)
    assert run(CONFIG, place, resume=True).finished
    assert "evaluation.json is gone or damaged" in caplog.text
    assert "The agent is saved again" in caplog.text
    after = {p.name: p.read_bytes() for p in (place / "evaluation.json", *_agent(place))}
    assert before == after
    assert_same_run(place, whole)
    assert read_result(place) == read_result(whole)


def _agent(place: Path) -> list[Path]:
    return [place / "agent" / name for name in ("agent.json", "weights.safetensors")]


def test_files_are_replaced_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_atomically(path, "old")

    def full(_: int) -> None:
        raise OSError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        with pytest.raises(OSError, match="full"):
            write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    assert unsealed(sealed({"a": (1, 2.5), "sha256": "x"})) == {"a": [1, 2.5]}
