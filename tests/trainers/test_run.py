"""Runs: what they leave behind, repeat, refuse, and compile."""

from __future__ import annotations

import csv
import json
import logging
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import Agent, load_agent
from phihp_torchrl.deployment.package import PACKAGE_FILE
from phihp_torchrl.evaluation import Evaluation
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import EvaluateConfig, EvaluatePhase, ModelConfig, compile_ahead, run
from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.run_directory import RunDirectory

from .run_parts import (
    CONFIG,
    EVALUATE,
    POLICY,
    UNITS,
    assert_equal,
    assert_same_run,
    rows,
    with_sections,
)

# Whole runs


def test_a_run_leaves_what_it_promises(whole: Path) -> None:
    names = {"config.yaml", "metadata.json", "metrics.csv", "evaluation.json", "report.html"}
    names |= {"episode.png", "episode.csv", ".lock"}
    assert names | {"agent", "phases", "checkpoints"} == {p.name for p in whole.iterdir()}
    assert not list((whole / "checkpoints").iterdir())
    metadata = json.loads((whole / "metadata.json").read_text())
    assert metadata["seconds"].keys() == {"model", "policy", "evaluate"}
    session = metadata["sessions"][0]
    assert session.keys() >= {"seed", "commit", "dirty", "command", "machine", "versions"}
    table = rows(whole)
    assert [row["unit"] for row in table] == [str(i) for i in range(UNITS)]
    assert [row["real_steps"] for row in table] == ["30"] + ["60"] * (UNITS - 1)
    agent = load_agent(whole / "agent")
    assert agent.metadata["samples"] == 60
    assert agent.metadata["config"]["policy"]["updates"] == 12
    returns = agent.metadata["returns"]["planner"]["returns"]
    assert len(returns) == 2
    with (whole / "episode.csv").open(newline="") as file:  # the first of those that count
        shown = [float(row["reward"]) for row in csv.DictReader(file) if row["reward"]]
    assert sum(shown) == pytest.approx(returns[0], rel=1e-5)


def test_a_seed_repeats_a_run_and_another_does_not(whole: Path, tmp_path: Path) -> None:
    model = replace(CONFIG, phases=("model",))
    torch.rand(3)  # what happened before does not matter
    run(model, tmp_path / "same")
    run(replace(model, seed=1), tmp_path / "other")
    assert rows(tmp_path / "same") == [
        {k: row[k] for k in rows(tmp_path / "same")[0]} for row in rows(whole)[:2]
    ]
    assert rows(tmp_path / "other") != rows(tmp_path / "same")


def test_a_phase_alone_does_what_it_did_in_the_whole_run(whole: Path, tmp_path: Path) -> None:
    later = replace(CONFIG, phases=("policy", "evaluate"), start_from=str(whole))
    # The settings of the phases done elsewhere are those they were done with.
    run(with_sections(later, model=ModelConfig(real_steps=999)), tmp_path / "later")
    ours = load_state(tmp_path / "later" / "phases" / "policy", metadata={"task": CONFIG.task})
    theirs = load_state(whole / "phases" / "policy", metadata={"task": CONFIG.task})
    assert_equal(ours["trainer"], theirs["trainer"])
    run(replace(CONFIG, phases=("evaluate",), start_from=str(whole)), tmp_path / "last")
    ours, theirs = (
        (p / "agent/weights.safetensors").read_bytes() for p in (whole, tmp_path / "last")
    )
    assert ours == theirs


def test_resuming_a_finished_run_changes_nothing(whole: Path) -> None:
    before = (whole / "metrics.csv").read_bytes()
    assert run(CONFIG, whole, resume=True).finished
    assert (whole / "metrics.csv").read_bytes() == before


# Refusing


def test_resuming_with_another_configuration_names_the_key(whole: Path) -> None:
    other = with_sections(CONFIG, policy=replace(POLICY, batch_size=9))
    with pytest.raises(ConfigError, match=r"policy\.batch_size: 9, not 8"):
        run(other, whole, resume=True)


def test_a_directory_with_a_run_is_not_overwritten(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="resume="):
        run(CONFIG, whole)
    (tmp_path / "thesis.tex").write_text("...")
    with pytest.raises(ConfigError, match="run_dir: expected an empty"):
        run(CONFIG, tmp_path)


def test_resume_needs_a_run(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no config\.yaml"):
        run(CONFIG, tmp_path, resume=True)


def test_from_needs_the_phases_before_of_the_same_task(whole: Path, tmp_path: Path) -> None:
    run(replace(CONFIG, phases=("model",)), tmp_path / "model")
    last = replace(CONFIG, phases=("evaluate",), start_from=str(tmp_path / "model"))
    with pytest.raises(CheckpointError, match="phases/policy"):
        run(last, tmp_path / "x")
    with pytest.raises(ConfigError, match="brief-pendulum"):
        run(replace(last, task="pendulum", start_from=str(whole)), tmp_path / "x")
    assert not (tmp_path / "x").exists()


# Compiled


@pytest.mark.usefixtures("traced")
def test_no_graph_breaks_and_none_is_compiled_twice(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A whole run; a break would fail it, for every graph is a full one."""
    # Where a core happens to be idle, another process would compile the same by Inductor.
    monkeypatch.setattr(compile_ahead, "has_idle_core", lambda threads, begun: False)
    torch._dynamo.utils.counters.clear()
    timed = replace(EVALUATE, latency_actions=2)
    config = with_sections(replace(CONFIG, compile=True), evaluate=timed)
    with torch._dynamo.config.patch(error_on_recompile=True):
        assert run(config, tmp_path / "compiled").finished
    counters = torch._dynamo.utils.counters
    assert not counters["graph_break"]
    # The TD3 step, imagined chunks, returns in model and world, and single plans, whose time is
    # measured. The batch of evaluation episodes is planned without compiling.
    assert counters["stats"]["unique_graphs"] == 5
    for ours, eager in zip(rows(tmp_path / "compiled"), rows(whole), strict=True):
        for key, value in eager.items():
            if value and key != "phase":
                assert float(ours[key]) == pytest.approx(float(value), rel=1e-3, abs=1e-3), key


def test_a_callers_defaults_of_dtype_and_device_change_no_result(
    whole: Path, tmp_path: Path
) -> None:
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        assert run(CONFIG, tmp_path / "run").finished
        assert (torch.get_default_dtype(), torch.zeros(1).device.type) == (torch.float64, "meta")
        agent = load_agent(tmp_path / "run" / "agent")
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)
    assert_same_run(tmp_path / "run", whole)
    start = get_task("pendulum").observe(torch.tensor([0.5, 0.0]))
    assert agent(TensorDict(observation=start))["action"].dtype == torch.float32


@pytest.mark.parametrize("copies", [True, False])
def test_plans_are_compiled_where_they_are_made_one_at_a_time(
    whole: Path, monkeypatch: pytest.MonkeyPatch, copies: bool
) -> None:
    agent, compiled = load_agent(whole / "agent", compile=True), list[bool]()
    world: Any = SimpleNamespace(copies=copies, has_env=True)

    def played(acting: Any, *_: Any, **__: Any) -> Evaluation:
        compiled.append(acting.planner._compiles)
        ones = torch.ones(1)
        return Evaluation("pendulum", 0, ones, ones.long(), ones > 0, seconds=1.0)

    def timed(acting: Any, *_: Any, **__: Any) -> Any:
        compiled.append(acting.planner._compiles)
        return SimpleNamespace(summary=lambda: {"latency_ms_p50": 1.0})

    module = import_module("phihp_torchrl.trainers.evaluate")
    monkeypatch.setattr(module, "evaluate", played)
    monkeypatch.setattr(module, "measure_latency", timed)
    phase = EvaluatePhase(agent, CONFIG, EvaluateConfig(), world, RunDirectory(whole), 0)
    phase.advance()
    assert compiled == [not copies, True], "returns, and the time of a plan"


@pytest.mark.parametrize("compiles", [True, False])
def test_a_package_of_the_plan_lies_beside_the_agent(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiles: bool
) -> None:
    """Another process makes it meanwhile, and the time of a plan is measured with it."""
    made, order = tmp_path / "made", list[str]()
    made.write_text("a package")

    def wait(seconds: float) -> bool:
        order.append("wait")
        return compiles

    def warm_up(agent: Agent, *, background: bool) -> Any:
        order.append("begin")
        return SimpleNamespace(wait=wait, package=made if compiles else None)

    def timed(agent: Agent, *_: Any, **__: Any) -> Any:
        order.append("actor" if agent.planner is None else "planner")
        return SimpleNamespace(summary=lambda: {"latency_ms_p50": 1.0})

    monkeypatch.setattr(Agent, "warm_up", warm_up)
    monkeypatch.setattr(import_module("phihp_torchrl.trainers.evaluate"), "measure_latency", timed)
    settings = replace(EVALUATE, latency_actions=2, packaged=True)
    config = with_sections(CONFIG, evaluate=settings)
    place = tmp_path / "run"
    assert run(replace(config, phases=("evaluate",), start_from=str(whole)), place).finished
    assert order == ["begin", "actor", "wait", "planner"]
    results = json.loads((place / "evaluation.json").read_text())["planner"]
    assert (results["packaged"], results["latency_ms_p50"]) == (compiles, 1.0)
    assert (place / "agent" / PACKAGE_FILE).is_file() is compiles


def test_plans_slower_than_a_time_step_are_told_once(
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def timed(agent: Agent, *_: Any, **__: Any) -> Any:
        times = {"latency_ms_mean": 51.0, "latency_ms_p50": 51.0}
        return SimpleNamespace(summary=lambda: times)

    monkeypatch.setattr(import_module("phihp_torchrl.trainers.evaluate"), "measure_latency", timed)
    config = with_sections(CONFIG, evaluate=replace(EVALUATE, latency_actions=2))
    config = replace(config, phases=("evaluate",), start_from=str(whole))
    with caplog.at_level(logging.WARNING):
        assert run(config, tmp_path / "run").finished
    assert caplog.text.count("A plan takes 51 ms, and the time step is 50 ms") == 1


def test_a_short_run_earns_no_package(whole: Path) -> None:
    assert not (whole / "agent" / PACKAGE_FILE).exists()
    assert "packaged" not in json.loads((whole / "evaluation.json").read_text())["planner"]
