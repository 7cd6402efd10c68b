"""What another process compiles for the policy phase while the model is learned."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_leaves

from phihp_torchrl import HybridDynamics, make_world
from phihp_torchrl.agents import AnalyticConfig, RefitConfig
from phihp_torchrl.compilation import OtherProcess
from phihp_torchrl.trainers import RunConfig, compile_ahead, run, spare
from phihp_torchrl.trainers.compile_ahead import CompileAhead, compile_policy, compiles_ahead
from phihp_torchrl.worlds import World

from .run_parts import CONFIG, POLICY, with_sections

COMPILING = ("imagination.rollouts", "agents.td3", "agents.refit", "agents.analytic_update")
EULER = "semi_implicit_euler"
REFIT = RefitConfig(interval=4, transitions=32, horizon=7, steps=3, batch_size=8)


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> set[Any]:
    """The functions that would be compiled, with the shapes for which they are called."""
    found: set[Any] = set()

    def compile_graph(function: Callable[..., Any], *, enabled: bool = True, **_: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            found.add((_name(function), *map(_described, tree_leaves((args, kwargs)))))
            return function(*args, **kwargs)

        return call if enabled else function

    for name in COMPILING:
        module = import_module(f"phihp_torchrl.{name}")
        monkeypatch.setattr(module, "compile_graph", compile_graph)
    return found


def _name(function: Callable[..., Any]) -> Any:
    """What is compiled, with all that is bound to it but modules and tensors."""
    if isinstance(function, partial):
        bound = (*function.args, *sorted(function.keywords.items()))
        return _name(function.func), *map(_described, tree_leaves(bound))
    config = getattr(getattr(function, "__self__", None), "config", None)
    return f"{function.__module__}.{function.__qualname__}", repr(config)


def _described(leaf: Any) -> str:
    """What of a leaf of arguments makes a graph another one."""
    if torch.is_tensor(leaf):
        return f"{tuple(leaf.shape)} {leaf.stride()} {leaf.dtype}"
    return repr(leaf) if isinstance(leaf, (int, float, str)) else type(leaf).__name__


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
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads, begun: False)
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
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads, begun: idle_core)
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

        def still_fits(self, model: Any) -> bool:
            return model.dynamics is not None

        def wait(self) -> None:
            assert (tmp_path / "run" / "phases" / "model").exists()
            assert not (tmp_path / "run" / "phases" / "policy").exists()
            told.append("wait")

        def end(self) -> None:
            told.append("end")

    monkeypatch.setattr(loop, "CompileAhead", Ahead)
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads, begun: cores > threads)
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


def test_what_goes_wrong_costs_the_run_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG", "phihp_torchrl")
    child = "phihp_torchrl.compilation.other_process._CHILD"
    monkeypatch.setattr(child, "raise SystemExit('no room')")
    CompileAhead(CONFIG, world_of(CONFIG)).wait()
    assert "compiled now: no room" in caplog.text

    def refuse(*_: Any) -> None:
        raise RuntimeError("a lock cannot be pickled")

    monkeypatch.setattr(compile_ahead.pickle, "dumps", refuse)
    ahead = CompileAhead(CONFIG, world_of(CONFIG))
    assert not ahead.is_at_work
    assert "a lock cannot be pickled" in caplog.text


@pytest.mark.parametrize(
    ("integrator", "other_world", "fits"),
    [(EULER, False, True), ("rk4", False, False), (EULER, True, False)],
)
def test_graphs_of_another_model_are_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, integrator: str, other_world: bool, fits: bool
) -> None:
    monkeypatch.setattr(compile_ahead, "pickle", None)  # so that nothing is begun
    world = world_of(CONFIG)
    ahead = CompileAhead(CONFIG, world)
    dynamics = HybridDynamics.hybrid(world.task, integrator=integrator)
    found = world_of(CONFIG) if other_world else world
    assert ahead.still_fits(SimpleNamespace(dynamics=dynamics, world=found)) is fits


@pytest.mark.skipif(sys.platform != "linux", reason="others tell of processes otherwise")
def test_another_process_is_ended_with_those_that_it_has_started() -> None:
    process = OtherProcess("time:sleep", [], tempfile.TemporaryDirectory())  # it takes no folder
    process.wait(60)
    assert process.ended
    assert "TypeError" in process.failure
    place = tempfile.TemporaryDirectory()
    process = OtherProcess(f"{__name__}:start_another", [], place)
    with pytest.raises(TimeoutError, match=r"still at work after 0\.01 s"):
        process.wait(0.01)
    started = Path(place.name, "started")
    while not started.exists():
        time.sleep(0.05)
    pid = started.read_text()
    assert is_alive(pid)
    process.end()
    assert process.ended
    assert not process.failure
    assert not Path(place.name).exists()
    while is_alive(pid):  # else the time limit of tests says so
        time.sleep(0.05)


def start_another(place: str) -> None:
    """What a process does that is ended: it starts another, as the compiler does, and waits."""
    other = subprocess.Popen(["sleep", "600"])
    written = Path(place, "writing")
    written.write_text(str(other.pid))
    written.rename(Path(place, "started"))
    other.wait()


def is_alive(pid: str) -> bool:
    """Whether a process runs, on Linux."""
    try:
        return Path("/proc", pid, "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("load", "begun", "has"),
    [(0.2, False, True), (1.0, False, False), (1.1, True, True), (1.6, True, False)],
)
def test_cores_that_others_use_are_not_to_spare(
    monkeypatch: pytest.MonkeyPatch, load: float, begun: bool, has: bool
) -> None:
    """A run that has worked for a minute is itself among the load of the machine."""
    monkeypatch.setattr(spare.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(spare.os, "getloadavg", lambda: (load, 9.0, 9.0), raising=False)
    assert spare.has_idle_core(1, begun=begun) is has


def test_all_threads_leave_no_core() -> None:
    assert not spare.has_idle_core(10_000, begun=True)
