"""The smallest run that goes through everything, and runs compared bit by bit."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.agents import RefitConfig, TD3Config
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import get_task, register_task
from phihp_torchrl.trainers import (
    CalibrateConfig,
    CollectConfig,
    EvaluateConfig,
    ModelConfig,
    PolicyConfig,
    RunConfig,
)
from phihp_torchrl.trainers.checkpoints import load_state, save_state

run_module = import_module("phihp_torchrl.trainers.run")  # the package has a function of this name

UNITS = 8  # 2 + 3 + 3
register_task(replace(get_task("pendulum"), name="brief-pendulum", max_steps=20), replace=True)
MODEL = ModelConfig(
    real_steps=60,
    steps_per_iteration=30,
    integrator="semi_implicit_euler",  # the choice of one has tests of its own, and fits five
    fit=FitConfig(steps=2),
    collect=CollectConfig(
        planning_horizon=3, replan_every=2, num_candidates=8, top_k=2, optim_steps=1
    ),
)
POLICY = PolicyConfig(
    updates=12,
    batch_size=8,
    num_worlds=4,
    chunk_steps=2,
    updates_per_step=2,
    replay_capacity=200,
    random_steps=16,
    evaluation_interval=4,
    evaluation_episodes=2,
    td3=TD3Config(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,)),
    refit=RefitConfig(interval=0),
)
CALIBRATE = CalibrateConfig(enabled=False)  # it has tests of its own
EVALUATE = EvaluateConfig(episodes=2, latency_actions=0, video=False, baselines="none")
CONFIG = RunConfig(
    task="brief-pendulum",
    checkpoint_interval=0.0,
    compile=False,
    progress=False,
    planner=CEMConfig(
        planning_horizon=2, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2
    ),
    sections={"model": MODEL, "policy": POLICY, "calibrate": CALIBRATE, "evaluate": EVALUATE},
)


def with_sections(config: RunConfig, **sections: Any) -> RunConfig:
    """``config`` with the settings of some phases replaced."""
    return replace(config, sections={**config.sections, **sections})


class Crash(Exception):
    """What ends a run in these tests."""


def rows(path: Path) -> list[dict[str, str]]:
    """The metrics of a run without its times."""
    with (path / "metrics.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if "seconds" not in k} for row in table]


def assert_equal(ours: Any, theirs: Any, name: str = "") -> None:
    """Bit by bit, but for times."""
    assert type(ours) is type(theirs), name
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys(), name
        for key in ours:
            if "seconds" not in str(key):
                assert_equal(ours[key], theirs[key], f"{name}.{key}")
    elif isinstance(ours, (list, tuple)):
        assert len(ours) == len(theirs), name
        for i, pair in enumerate(zip(ours, theirs, strict=True)):
            assert_equal(*pair, f"{name}[{i}]")
    elif isinstance(ours, Tensor):
        assert torch.equal(ours, theirs), name
    else:
        assert ours == theirs, name


def assert_same_run(ours: Path, theirs: Path) -> None:
    assert rows(ours) == rows(theirs)
    for phase in ("model", "policy", "evaluate"):
        states = [
            load_state(path / "phases" / phase, metadata={"task": CONFIG.task})
            for path in (ours, theirs)
        ]
        assert_equal(*states, phase)
    weights = [(path / "agent" / "weights.safetensors").read_bytes() for path in (ours, theirs)]
    assert weights[0] == weights[1]


def forget_settings(path: Path) -> None:
    """Leave a run's folder as it was before anything in it had a record of the settings."""
    place = path / "metadata.json"
    metadata = json.loads(place.read_text())
    for key in ("config", "code", "sha256"):
        metadata.pop(key, None)
    place.write_text(json.dumps(metadata))
    for phase in (path / "phases").iterdir():
        origin = {"task": CONFIG.task}
        state = load_state(phase, metadata=origin)
        del state["settings"]
        shutil.rmtree(phase)
        save_state(phase, state, metadata=origin)
