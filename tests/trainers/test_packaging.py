"""When a run leaves a package of its plan."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from phihp_torchrl import Agent, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import EvaluateConfig, packaging

from .run_parts import CONFIG


def asked(
    monkeypatch: pytest.MonkeyPatch,
    *,
    packaged: Any = "auto",
    plans: bool = True,
    seconds: float = 200.0,
    compiled: bool = False,
    cores: float = 2,
    threads: int = 1,
    copies: bool = True,
    plugins: tuple[str, ...] = (),
) -> bool:
    monkeypatch.setattr(packaging, "_idle_cores", lambda threads: cores - threads)
    task = get_task("pendulum")
    planner = CEMConfig() if plans else None
    agent = Agent(
        task, dynamics=HybridDynamics.hybrid(task), actor=Actor(task), planner_config=planner
    )
    record = {"seconds": {"model": 20.0, "policy": seconds - 20.0}}
    context: Any = SimpleNamespace(
        settings=EvaluateConfig(packaged=packaged),
        directory=SimpleNamespace(read_metadata=lambda: record),
        compile=compiled,
        task=task,
        world=SimpleNamespace(copies=copies),
        config=replace(CONFIG, threads=threads, plugins=plugins),
    )
    return packaging.packages_plan(context, agent)


def test_a_long_run_with_a_core_to_spare_leaves_one(monkeypatch):
    assert asked(monkeypatch)


@pytest.mark.parametrize(
    "changes",
    [
        {"plans": False},
        {"seconds": 40.0},
        {"compiled": True},
        {"cores": 1},
        {"cores": 1.4},  # another run beside this one
        {"threads": 2},
        {"copies": False},
        {"plugins": ("my_task.py",)},
    ],
)
def test_others_do_not(monkeypatch, changes):
    assert not asked(monkeypatch, **changes)


@pytest.mark.parametrize(("load", "idle"), [(0.2, 1.0), (1.1, 0.9), (2.5, -0.5)])
def test_cores_that_others_use_are_not_to_spare(monkeypatch, load, idle):
    monkeypatch.setattr(packaging.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(packaging.os, "getloadavg", lambda: (load, 9.0, 9.0), raising=False)
    assert packaging._idle_cores(1) == pytest.approx(idle)


def test_what_is_asked_for_is_done_where_there_is_a_plan(monkeypatch):
    assert asked(monkeypatch, packaged=True, seconds=1.0, cores=1)
    assert not asked(monkeypatch, packaged=False)
    assert not asked(monkeypatch, packaged=True, plans=False)
