"""What another process compiles for the policy phase while the model is learned."""

from __future__ import annotations

import pickle
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_leaves

from phihp_torchrl import make_world
from phihp_torchrl.agents import AnalyticConfig, RefitConfig
from phihp_torchrl.compilation import OtherProcess
from phihp_torchrl.trainers import RunConfig, compile_ahead, idle, run
from phihp_torchrl.trainers.compile_ahead import CompileAhead, compile_policy, compiles_ahead
from phihp_torchrl.worlds import World

from .run_parts import CONFIG, POLICY, with_sections

COMPILING = ("imagination.rollouts", "agents.td3", "agents.refit", "agents.analytic_update")
REFIT = RefitConfig(interval=4, transitions=32, horizon=7, steps=3, batch_size=8)


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> set[Any]:
    """The functions that would be compiled, with the shapes for which they are called."""
    found: set[Any] = set()

    def compile_graph(function: Callable[..., Any], *, enabled: bool = True, **_: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            shapes = [tuple(x.shape) for x in tree_leaves((args, kwargs)) if torch.is_tensor(x)]
            found.add((getattr(function, "__qualname__", "partial"), tuple(shapes)))
            return function(*args, **kwargs)

        return call if enabled else function

    for name in COMPILING:
        module = import_module(f"phihp_torchrl.{name}")
        monkeypatch.setattr(module, "compile_graph", compile_graph)
    return found


@pytest.mark.parametrize(
    "policy",
    [
        replace(POLICY, refit=REFIT),
        replace(POLICY, start=replace(POLICY.start, data=0.5), evaluation_steps=13),
        replace(POLICY, method="analytic", analytic=AnalyticConfig(horizon=4, critic_updates=4)),
    ],
)
def test_it_compiles_what_the_run_does(
    graphs: set[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, policy: Any
) -> None:
    config = with_sections(replace(CONFIG, compile=True, phases=("model", "policy")), policy=policy)
    place = tmp_path / "run"
    place.write_bytes(pickle.dumps((config, world_of(config))))
    compile_policy(str(tmp_path))
    ahead = set(graphs)
    graphs.clear()
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads: False)
    assert run(config, tmp_path / "whole").finished
    assert ahead
    assert ahead == graphs


def world_of(config: RunConfig) -> World:
    return make_world(config.task, config.world)


@pytest.mark.parametrize(
    ("changes", "idle_core", "expected"),
    [
        ({}, True, True),
        ({}, False, False),
        ({"plugins": ("my_task.py",)}, True, False),
        ({"phases": ("model",)}, True, False),
    ],
)
def test_it_costs_nobody_much(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], idle_core: bool, expected: bool
) -> None:
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads: idle_core)
    config = replace(CONFIG, **changes)
    assert compiles_ahead(config, world_of(config)) is expected


@pytest.mark.parametrize(("compiles", "cores"), [(True, 2), (False, 2), (True, 1)])
def test_a_run_waits_for_it_before_the_policy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, compiles: bool, cores: int
) -> None:
    loop, told = import_module("phihp_torchrl.trainers.run_loop"), list[str]()

    class Ahead:
        is_at_work = True

        def __init__(self, config: RunConfig, world: World) -> None:
            told.append("begin")

        def wait(self) -> None:
            assert (tmp_path / "run" / "phases" / "model").exists()
            assert not (tmp_path / "run" / "phases" / "policy").exists()
            told.append("wait")

        def end(self) -> None:
            told.append("end")

    monkeypatch.setattr(loop, "CompileAhead", Ahead)
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads: cores > threads)
    monkeypatch.setattr("phihp_torchrl.compilation.graphs.torch.compile", lambda of, **_: of)
    config = replace(CONFIG, compile=compiles, phases=("model", "policy"))
    assert run(config, tmp_path / "run").finished
    assert told == (["begin", "wait", "end"] if compiles and cores > 1 else [])


def test_what_cannot_be_given_is_compiled_by_the_run() -> None:
    world: Any = lambda: None  # noqa: E731 (a function without a name is what cannot be pickled)
    ahead = CompileAhead(CONFIG, world)
    assert not ahead.is_at_work
    ahead.wait()
    ahead.end()


def test_a_process_that_fails_costs_the_run_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    child = "phihp_torchrl.compilation.other_process._CHILD"
    monkeypatch.setattr(child, "raise SystemExit('no room')")
    ahead = CompileAhead(CONFIG, world_of(CONFIG))
    ahead.wait()
    assert not ahead.is_at_work


def test_another_process_is_waited_for_and_ended() -> None:
    place = tempfile.TemporaryDirectory()
    process = OtherProcess("time:sleep", [], place)  # which takes no folder
    process.wait(60)
    assert process.ended
    assert "TypeError" in process.failure
    place = tempfile.TemporaryDirectory()
    process = OtherProcess(f"{__name__}:wait_long", ["600"], place)
    with pytest.raises(TimeoutError, match=r"still at work after 0\.01 s"):
        process.wait(0.01)
    assert not process.failure
    process.end()
    assert process.ended


def wait_long(place: str, seconds: str) -> None:
    """What a process does that is ended."""
    import time

    time.sleep(float(seconds))


@pytest.mark.parametrize(("load", "has"), [(0.2, True), (1.1, True), (1.6, False), (2.5, False)])
def test_cores_that_others_use_are_not_to_spare(
    monkeypatch: pytest.MonkeyPatch, load: float, has: bool
) -> None:
    monkeypatch.setattr(idle.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(idle.os, "getloadavg", lambda: (load, 9.0, 9.0), raising=False)
    assert idle.has_idle_core(1) is has


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the load is not asked for")
def test_all_threads_leave_no_core() -> None:
    assert not idle.has_idle_core(10_000)
