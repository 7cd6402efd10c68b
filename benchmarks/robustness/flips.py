"""Single bits of a run and of an agent are flipped, and everything is read again.

    python benchmarks/robustness/flips.py                # 600 flips
    python benchmarks/robustness/flips.py --flips 60

Every kind of file of a stopped and of a finished run is damaged in turn, one bit at a time, and all
that a resumed run or a user reads of it is read: it must be as it was, or be refused or restored by
name. Writes results/robustness/flips.json.
"""

from __future__ import annotations

import argparse
import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointError

from found import write_part
from phihp_torchrl import load_agent
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.trainers import RunDirectory, load_latest, load_state, read_rows, read_run_config
from small_run import TASK, UNITS, prepare, stopped_run, whole_run, without_times

KINDS = {
    "config.yaml": ("stopped", "config.yaml"),
    "metadata.json": ("stopped", "metadata.json"),
    "metrics.csv": ("stopped", "metrics.csv"),
    "checkpoint: tensors": ("stopped", "checkpoints/*/**/tensors.safetensors"),
    "checkpoint: tree": ("stopped", "checkpoints/*/**/tree.json"),
    "checkpoint: manifest": ("stopped", "checkpoints/*/manifest.json"),
    "phase: tensors": ("stopped", "phases/model/**/tensors.safetensors"),
    "phase: tree": ("stopped", "phases/model/**/tree.json"),
    "phase: manifest": ("stopped", "phases/model/manifest.json"),
    "evaluation.json": ("whole", "evaluation.json"),
    "agent.json": ("whole", "agent/agent.json"),
    "weights.safetensors": ("whole", "agent/weights.safetensors"),
}
"""What is flipped, and the run and the pattern of its files; of several the newest."""


def main() -> None:
    """Flip bits, and write what became of each kind of file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flips", type=int, default=600)
    count = parser.parse_args().flips
    config = prepare()
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        whole_run(config, place / "whole")
        stopped_run(config, place / "stopped")
        found = flip_bits(place, count)
    write_part("flips", {"flips": found})
    print(found)


def flip_bits(place: Path, flips: int) -> dict[str, dict[str, int]]:
    """Flip single bits of each kind of file, and read everything again."""
    draw = random.Random(1)
    found: dict[str, dict[str, int]] = {}
    for kind, (source, pattern) in KINDS.items():
        path = sorted((place / source).glob(pattern))[-1]
        read = reader(kind, place / source)
        good, data = read(), path.read_bytes()
        counts: Counter[str] = Counter()
        for _ in range(flips // len(KINDS)):
            changed = bytearray(data)
            changed[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            path.write_bytes(changed)
            try:
                counts["changes nothing" if read() == good else "silently wrong"] += 1
            except Noticed:
                counts["noticed and restored"] += 1
            except (ConfigError, CheckpointError, AgentError):
                counts["refused by name"] += 1
        path.write_bytes(data)
        found[kind] = dict(counts)
    return found


class Noticed(Exception):
    """A damage that a resumed run repairs with a warning, or does without."""


def reader(kind: str, path: Path) -> Callable[[], Any]:
    """A function that reads what a resumed run, or a user, reads of a kind of file."""
    directory, origin = RunDirectory(path), {"task": TASK}

    def checkpoint() -> Any:
        try:
            state = load_state(newest, metadata=origin)
        except CheckpointError as error:
            kept = load_latest_copy(directory, origin)
            assert kept == UNITS, "the checkpoint before was not used"
            raise Noticed from error
        return without_times(state)

    def table() -> Any:
        if read_rows(directory.metrics) != rows:
            raise Noticed
        return rows

    def settings() -> Any:
        found = read_run_config(directory.read_config(), imports=False)
        if found.to_mapping() != read_run_config(started, imports=False).to_mapping():
            raise ConfigError("config.yaml", "was changed")
        return found.to_mapping()

    def metadata() -> Any:
        return {k: v for k, v in directory.read_metadata().items() if k in known}

    def agent() -> Any:
        made = load_agent(path / "agent")
        return made.config, without_times(dict(made.state_dict())), made.metadata

    known = directory.read_metadata()
    started = known["config"]
    rows = read_rows(directory.metrics)
    newest = max((path / "checkpoints").glob("unit-*"), default=path)
    readers: dict[str, Callable[[], Any]] = {
        "config.yaml": settings,
        "metadata.json": metadata,
        "metrics.csv": table,
        "evaluation.json": directory.read_evaluation,
    }
    if kind.startswith("checkpoint"):
        return checkpoint
    if kind.startswith("phase"):
        return lambda: without_times(load_state(path / "phases" / "model", metadata=origin))
    return readers.get(kind, agent)


def load_latest_copy(directory: RunDirectory, origin: dict[str, str]) -> int:
    """The step of the checkpoint that a resumed run would use, found in a copy."""
    with tempfile.TemporaryDirectory() as place:
        copy = RunDirectory(Path(place) / "run")
        shutil.copytree(directory.rotation.directory, copy.rotation.directory)
        found = load_latest(copy.rotation, metadata=origin)
        assert found is not None
        return found[0]


if __name__ == "__main__":
    main()
