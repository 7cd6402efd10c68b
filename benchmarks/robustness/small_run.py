"""The run that is killed and damaged: all phases, as small as one can be, in a forked process.

Pictures, the page and the rehearsal are left out: they take most of the time of so small a run, and
nothing that a resumed run reads comes from them.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from phihp_torchrl import get_task, load_config
from phihp_torchrl.tasks import register_task
from phihp_torchrl.trainers import (
    RunConfig,
    RunDirectory,
    load_state,
    read_result,
    read_rows,
    read_run_config,
    run,
)

TASK = "brief-pendulum"
PHASES = ("model", "policy", "evaluate")
OPERATIONS = ("replace", "rename", "fsync", "mkdir", "unlink", "rmdir")
"""Functions of ``os`` by which files come, move and go."""
UNITS = 3
"""Units of work after which a stopped run stands in its second phase, with checkpoints of it."""
TINY = {
    "checkpoint_interval": 0, "compile": False, "progress": False, "calibrate.enabled": False,
    "model.real_steps": 60, "model.steps_per_iteration": 30, "model.fit.steps": 2,
    "model.integrator": "semi_implicit_euler",
    "model.collect.planning_horizon": 3, "model.collect.replan_every": 2,
    "model.collect.num_candidates": 8, "model.collect.top_k": 2, "model.collect.optim_steps": 1,
    "policy.updates": 12, "policy.chunk_steps": 2, "policy.updates_per_step": 2,
    "policy.batch_size": 8, "policy.num_worlds": 4, "policy.replay_capacity": 200,
    "policy.random_steps": 16, "policy.evaluation_interval": 4, "policy.evaluation_episodes": 2,
    "policy.refit.interval": 0, "policy.td3.actor_hidden_sizes": [8],
    "policy.td3.critic_hidden_sizes": [8], "evaluate.episodes": 2, "evaluate.latency_actions": 0,
    "evaluate.video": False, "evaluate.baselines": "none", "planner.planning_horizon": 2,
    "planner.optim_steps": 1, "planner.num_candidates": 8, "planner.top_k": 2,
    "planner.num_policy_candidates": 2, "planner.warm_start": False,
}  # fmt: skip


def prepare() -> RunConfig:
    """Settings of the run; what takes time to show, and is not looked at, is left out."""
    torch.set_num_threads(1)
    logging.disable(logging.CRITICAL)
    register_task(replace(get_task("pendulum"), name=TASK, max_steps=20), replace=True)
    for module, name in (("evaluate", "show_episode"), ("run", "rehearse"), ("run", "report_run")):
        setattr(sys.modules[f"phihp_torchrl.trainers.{module}"], name, lambda *_, **__: [])
    return read_run_config(load_config(TASK, overrides=TINY))


@contextmanager
def child(config: RunConfig, path: Path, **harm: Any) -> Iterator[int]:
    """A context with a forked process that runs a run, or goes on with it."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            code = _work(config, path, **harm)
        finally:  # whatever happens, nothing of the parent goes on here
            os._exit(code)
    yield pid


def wait(pid: int) -> int:
    """The exit code of a process, negative for a signal."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def whole_run(config: RunConfig, path: Path) -> tuple[float, int]:
    """Make the run that nothing disturbs; its seconds, and its operations on files."""
    run(config, path.with_name("first"))  # what is imported is imported once, before all forks
    count, start = path.with_name("operations.txt"), time.monotonic()
    with child(config, path, counted=count) as pid:
        if wait(pid) != 0:
            raise RuntimeError("the run that nothing disturbs has failed")
    return time.monotonic() - start, int(count.read_text())


def stopped_run(config: RunConfig, path: Path) -> None:
    """Make a run that was asked to stop in its second phase, after two checkpoints of it."""
    with child(config, path, units=UNITS) as pid:
        if wait(pid) != 3:
            raise RuntimeError("the run that was to stop has not stopped")


def _work(
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
        _stop_after(units)
    result = run(config, path, resume=RunDirectory(path).config.is_file())
    if counted is not None:
        counted.write_text(str(made))
    return 0 if result.finished else 3


def _stop_after(units: int) -> None:
    made = sys.modules["phihp_torchrl.trainers.run_loop"].RunLoop
    log_unit = made._log_unit

    def stopping(self: Any, *arguments: Any) -> None:
        log_unit(self, *arguments)
        if self.position.unit == units:
            os.kill(os.getpid(), signal.SIGTERM)

    made._log_unit = stopping


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
    return {
        "states": states,
        "rows": without_times(read_rows(path / "metrics.csv")),
        "evaluation": without_times(RunDirectory(path).read_evaluation()),
        "weights": (path / "agent" / "weights.safetensors").read_bytes(),
        "result": str(read_result(path)),
    }
