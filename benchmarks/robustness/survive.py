"""What runs and agents survive: kills, flipped bits, and folders of strangers.

    python benchmarks/robustness/survive.py                     # 40 kills, 600 flips
    python benchmarks/robustness/survive.py --kills 4 --flips 60

A run of all phases, as small as one can be, is killed (SIGKILL) at random times, and before its
operations on files one after the other, and resumed: what it ends with must be that of a run which
nothing disturbed, bit by bit. Then single bits of a stopped and of a finished run are flipped, over
every kind of file in turn, and all that a resumed run or a user reads is read: it must be as it
was, or be refused or restored by name. The folders of strangers are those of the tests
(tests/trainers/test_hostile.py, tests/deployment/test_saving.py), which are run. Writes
results/robustness/.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError

from phihp_torchrl import get_task, load_agent, load_config
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.tasks import register_task
from phihp_torchrl.trainers import (
    RunConfig,
    RunDirectory,
    load_latest,
    load_state,
    read_result,
    read_rows,
    read_run_config,
    run,
)

RESULTS = Path("results/robustness")
HOSTILE = ("tests/trainers/test_hostile.py", "tests/deployment/test_saving.py")
TASK = "brief-pendulum"
AT_RANDOM, BEFORE_OPERATION = "at a random time", "before an operation on files"
PHASES = ("model", "policy", "evaluate")
OPERATIONS = ("replace", "rename", "fsync", "mkdir", "unlink", "rmdir")
"""Functions of ``os`` by which files come, move and go."""
TINY = {
    "checkpoint_interval": 0, "compile": False, "progress": False, "calibrate.enabled": False,
    "model.real_steps": 60, "model.steps_per_iteration": 30, "model.fit.steps": 2,
    "model.collect.planning_horizon": 3, "model.collect.replan_every": 2,
    "model.collect.num_candidates": 8, "model.collect.top_k": 2, "model.collect.optim_steps": 1,
    "policy.updates": 12,
    "policy.batch_size": 8, "policy.num_worlds": 4, "policy.replay_capacity": 200,
    "policy.random_steps": 16, "policy.evaluation_interval": 4, "policy.evaluation_episodes": 2,
    "policy.refit.interval": 0, "policy.td3.actor_hidden_sizes": [8],
    "policy.td3.critic_hidden_sizes": [8], "evaluate.episodes": 2, "evaluate.latency_actions": 0,
    "evaluate.video": False, "evaluate.baselines": "none", "planner.planning_horizon": 2,
    "planner.optim_steps": 1, "planner.num_candidates": 8, "planner.top_k": 2,
    "planner.num_policy_candidates": 2, "planner.warm_start": False,
}  # fmt: skip


def main() -> None:
    """Make the tries, and write what became of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=40, help="of each of the two kinds")
    parser.add_argument("--flips", type=int, default=600)
    parser.add_argument("--out-dir", type=Path, default=RESULTS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.CRITICAL)
    register_task(replace(get_task("pendulum"), name=TASK, max_steps=20), replace=True)
    config = read_run_config(load_config(TASK, overrides=TINY))
    found: dict[str, Any] = {"origin": describe_origin(seed=0), "kills": {}}
    with tempfile.TemporaryDirectory() as place:
        for part in parts(config, Path(place), options.kills, options.flips):
            found |= part
            write(found, options.out_dir)  # what was tried so far, should it be stopped
    found["hostile"] = hostile_folders()
    write(found, options.out_dir)


def write(found: dict[str, Any], place: Path) -> None:
    """Write the page of results, and the numbers on it."""
    place.mkdir(parents=True, exist_ok=True)
    (place / "robustness.json").write_text(json.dumps(found, indent=2) + "\n")
    (place / "README.md").write_text(page(found))


def parts(config: RunConfig, place: Path, kills: int, flips: int) -> Iterator[dict[str, Any]]:
    """Flips and kills of one small run, the results as they come."""
    start = time.monotonic()
    count = place / "operations.txt"
    with child(config, place / "whole", counted=count) as pid:
        assert wait(pid) == 0, "the run that nothing disturbs has failed"
    seconds, operations = time.monotonic() - start, int(count.read_text())
    yield {"seconds_of_a_run": round(seconds, 1), "operations_on_files": operations}
    stop(config, place / "stopped")
    yield {"flips": flip_bits(config, place, flips)}
    draw, expected = random.Random(0), outcome(place / "whole")
    killed: dict[str, Counter[str]] = {kind: Counter() for kind in (AT_RANDOM, BEFORE_OPERATION)}
    for number in range(kills):
        step = 1 + number * operations // kills
        harms: dict[str, dict[str, Any]] = {
            AT_RANDOM: {"after": draw.uniform(0, seconds)},
            BEFORE_OPERATION: {"step": step},
        }
        for kind, harm in harms.items():
            killed[kind][survives(config, place / "killed", expected, **harm)] += 1
            shutil.rmtree(place / "killed", ignore_errors=True)
            yield {"kills": {name: dict(counts) for name, counts in killed.items()}}


class child:
    """A context with a forked process that runs a run, or goes on with it."""

    def __init__(self, config: RunConfig, path: Path, **harm: Any) -> None:
        self.pid = os.fork()
        if self.pid == 0:
            code = 1
            try:
                code = work(config, path, **harm)
            finally:  # whatever happens, nothing of the parent goes on here
                os._exit(code)

    def __enter__(self) -> int:
        return self.pid

    def __exit__(self, *_: object) -> None:
        return None


def work(
    config: RunConfig,
    path: Path,
    *,
    operation: int | None = None,
    units: int | None = None,
    counted: Path | None = None,
) -> int:
    """Run or resume in this process; killed before an operation, or stopped after units."""
    made = 0

    def counting(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal made
            made += 1
            if made == operation:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **options)

        return call

    if operation is not None or counted is not None:
        for name in OPERATIONS:
            setattr(os, name, counting(getattr(os, name)))
    if units is not None:
        module = sys.modules["phihp_torchrl.trainers.run"]
        log_unit = module._Run._log_unit

        def stopping(self: Any, *arguments: Any) -> None:
            log_unit(self, *arguments)
            if self.position.unit == units:
                os.kill(os.getpid(), signal.SIGTERM)

        module._Run._log_unit = stopping
    result = run(config, path, resume=RunDirectory(path).config.is_file())
    if counted is not None:
        counted.write_text(str(made))
    return 0 if result.finished else 3


def wait(pid: int) -> int:
    """The exit code of a process, negative for a signal."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def survives(
    config: RunConfig,
    path: Path,
    expected: dict[str, Any],
    *,
    after: float | None = None,
    step: int | None = None,
) -> str:
    """Kill a run after seconds, or before an operation; resume it, and say how it ended."""
    with child(config, path, operation=step) as pid:
        if after is not None:
            time.sleep(after)
            os.kill(pid, signal.SIGKILL)
        if wait(pid) == 0:
            return "ended before it was killed"
    with child(config, path) as pid:
        if wait(pid) != 0:
            return "lost: it could not be resumed"
    return "resumed, equal to the bit" if outcome(path) == expected else "lost: it ended otherwise"


def stop(config: RunConfig, path: Path) -> None:
    """A run that was asked to stop in its second phase, after two checkpoints of that phase."""
    with child(config, path, units=3) as pid:
        assert wait(pid) == 3


def without_times(value: Any) -> Any:
    """A state as plain values, without what a clock has measured."""
    if isinstance(value, dict):
        return {str(k): without_times(v) for k, v in value.items() if "seconds" not in str(k)}
    if isinstance(value, (list, tuple)):
        return [without_times(item) for item in value]
    if hasattr(value, "to_dict"):
        return without_times(value.to_dict())
    if isinstance(value, torch.Tensor):
        return (str(value.dtype), list(value.shape), value.contiguous().numpy().tobytes().hex())
    return value


def outcome(path: Path) -> dict[str, Any]:
    """Everything that a finished run has to show, without times."""
    states = {
        name: without_times(load_state(path / "phases" / name, metadata={"task": TASK}))
        for name in PHASES
    }
    evaluation = without_times(RunDirectory(path).read_evaluation())
    weights = (path / "agent" / "weights.safetensors").read_bytes()
    return {
        "states": states,
        "rows": without_times(read_rows(path / "metrics.csv")),
        "evaluation": evaluation,
        "weights": weights,
        "result": str(read_result(path)),
    }


# Flipped bits

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

UNITS, CHECKPOINTS = 4, 2


def flip_bits(config: RunConfig, place: Path, flips: int) -> dict[str, dict[str, int]]:
    """Flip single bits of each kind of file, and read everything again."""
    draw = random.Random(1)
    found: dict[str, dict[str, int]] = {}
    for kind, (source, pattern) in KINDS.items():
        path = sorted((place / source).glob(pattern))[-1]
        read = reader(kind, config, place / source)
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


def reader(kind: str, config: RunConfig, path: Path) -> Callable[[], Any]:
    """A function that reads what a resumed run, or a user, reads of a kind of file."""
    directory, origin = RunDirectory(path), {"task": TASK}

    def checkpoint() -> Any:
        try:
            state = load_state(newest, metadata=origin)
        except CheckpointError as error:
            kept = load_latest_copy(directory, origin)
            assert kept == UNITS - 1, "the checkpoint before was not used"
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


# Folders of strangers


def hostile_folders() -> dict[str, int]:
    """How many kinds were tried by the tests, and how many of them executed something."""
    words = ["-q", "-p", "no:cacheprovider", "-k", "executed", *HOSTILE]
    done = subprocess.run([sys.executable, "-m", "pytest", *words], capture_output=True, text=True)
    counts = {word: int(n) for n, word in re.findall(r"(\d+) (passed|failed)", done.stdout)}
    passed, failed = counts.get("passed", 0), counts.get("failed", 0)
    return {"kinds": passed + failed, "executed": failed}


def page(found: dict[str, Any]) -> str:
    """The page of results, with the parts that there are, and as many tries as were made."""
    text = (
        "# What runs and agents survive\n\n"
        f"Made by `python benchmarks/robustness/survive.py` ({origin_text(found['origin'])}). The "
        f"run has all phases and took {found['seconds_of_a_run']} s, beside other work.\n"
    )
    if flips := found.get("flips"):
        columns = ["refused by name", "noticed and restored", "changes nothing", "silently wrong"]
        rows = [
            [f"`{k}`", *(str(c.get(column, 0)) for column in columns)] for k, c in flips.items()
        ]
        total = ["all", *(str(sum(int(row[i + 1]) for row in rows)) for i in range(len(columns)))]
        text += (
            "\n## A flipped bit\n\n"
            "One bit of one file at a time, then all that is read back of it.\n\n"
            f"{markdown_table(['file', *columns], [*rows, total])}"
        ).rstrip() + "\n"
    if kills := found.get("kills"):
        ends = sorted({end for counts in kills.values() for end in counts})
        rows = [[kind, *(str(c.get(end, 0)) for end in ends)] for kind, c in kills.items()]
        text += (
            "\n## Killed\n\n"
            "SIGKILL at a random time of the run, and before one of its "
            f"{found['operations_on_files']} operations on files. A run that is resumed must end "
            "with the states, rows, agent and evaluation of one that nothing disturbed.\n\n"
            f"{markdown_table(['killed', *ends], rows)}"
        ).rstrip() + "\n"
    if hostile := found.get("hostile"):
        text += (
            "\n## Folders of strangers\n\n"
            f"{hostile['kinds']} kinds of hostile runs and agents were read; {hostile['executed']} "
            "executed, read or wrote what they named.\n"
        )
    return text


if __name__ == "__main__":
    main()
