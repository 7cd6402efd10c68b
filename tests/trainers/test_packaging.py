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
    idle_core: bool = True,
    copies: bool = True,
    plugins: tuple[str, ...] = (),
) -> bool:
    monkeypatch.setattr(packaging, "has_idle_core", lambda threads, begun: idle_core)
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
        config=replace(CONFIG, plugins=plugins),
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
        {"idle_core": False},
        {"copies": False},
        {"plugins": ("my_task.py",)},
    ],
)
def test_others_do_not(monkeypatch, changes):
    assert not asked(monkeypatch, **changes)


def test_what_is_asked_for_is_done_where_there_is_a_plan(monkeypatch):
    assert asked(monkeypatch, packaged=True, seconds=1.0, idle_core=False)
    assert not asked(monkeypatch, packaged=False)
    assert not asked(monkeypatch, packaged=True, plans=False)
