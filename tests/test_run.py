"""Runs: logged, checkpointed, killed and resumed."""

from __future__ import annotations

import csv
import json
import logging
import os
import signal
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.checkpoint import CheckpointError, CheckpointRotation

from phihp_torchrl.agents import TD3Config
from phihp_torchrl.deployment import load_agent
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.tasks import get_task, register_task
from phihp_torchrl.trainers import (
    CollectConfig,
    ConfigError,
    EvaluateConfig,
    LoggerConfig,
    ModelConfig,
    PolicyConfig,
    RunConfig,
    RunLogger,
    make_logger,
    run,
)
from phihp_torchrl.trainers.checkpoints import load_latest, load_state, save_state
from phihp_torchrl.trainers.interrupt import Interrupt
from phihp_torchrl.trainers.run_directory import MetricsTable

run_module = import_module("phihp_torchrl.trainers.run")  # the package has a function of this name

# The smallest run that goes through everything: 2 + 3 + 3 units of work.
UNITS = 8
register_task(replace(get_task("pendulum"), name="brief-pendulum", max_steps=20), replace=True)
CONFIG = RunConfig(
    task="brief-pendulum",
    checkpoint_interval=0.0,
    progress=False,
    model=ModelConfig(
        real_steps=60,
        steps_per_iteration=30,
        fit=FitConfig(steps=2),
        collect=CollectConfig(
            planning_horizon=3, replan_every=2, num_candidates=8, top_k=2, optim_steps=1
        ),
    ),
    policy=PolicyConfig(
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
    ),
    planner=PlannerConfig(
        planning_horizon=2, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2
    ),
    evaluate=EvaluateConfig(episodes=2, latency_actions=0, video=False),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbed."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    assert run(CONFIG, path).finished
    return path


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


# ------------------------------------------------------------------------------------- whole runs


def test_a_run_leaves_what_it_promises(whole: Path) -> None:
    names = {"config.yaml", "metadata.json", "metrics.csv", "evaluation.json", "episode.png"}
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
    assert len(agent.metadata["returns"]["planner"]["returns"]) == 2


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
    run(replace(later, model=ModelConfig(real_steps=999)), tmp_path / "later")
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


# ------------------------------------------------------------------------------------- killed runs

KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from test_run import CONFIG, run, run_module

method = getattr(run_module._Run, {method!r})

def killed(self, *arguments):
    if self.position.unit == {unit}:
        if {after}:
            method(self, *arguments)
        os.kill(os.getpid(), signal.SIGKILL)
    return method(self, *arguments)

setattr(run_module._Run, {method!r}, killed)
run(CONFIG, {path!r})
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "method", "after"),
    [
        pytest.param(1, "_log_unit", True, id="model: after its row, before its checkpoint"),
        pytest.param(4, "_log_unit", True, id="policy: after its row, before its checkpoint"),
        pytest.param(6, "_save", True, id="evaluate: after a checkpoint"),
    ],
)
def test_a_killed_run_goes_on_as_if_nothing_had_happened(
    whole: Path, tmp_path: Path, unit: int, method: str, after: bool
) -> None:
    path = tmp_path / "killed"
    script = KILLED.format(
        tests=str(Path(__file__).parent), method=method, unit=unit, after=after, path=str(path)
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    torch.rand(7)  # the process that resumes has a past of its own
    assert run(CONFIG, path, resume=True).finished
    assert_same_run(path, whole)


class Crash(Exception):
    pass


@pytest.mark.parametrize("unit", [0, 1, 3, UNITS - 1])
def test_a_crash_loses_nothing(
    whole: Path, tmp_path: Path, unit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_unit = run_module._Run._log_unit

    def crash(self: Any, *arguments: Any) -> None:
        log_unit(self, *arguments)
        if self.position.unit == unit:
            raise Crash

    monkeypatch.setattr(run_module._Run, "_log_unit", crash)
    with pytest.raises(Crash):
        run(CONFIG, tmp_path / "run")
    monkeypatch.undo()
    assert run(CONFIG, tmp_path / "run", resume=True).finished
    assert_same_run(tmp_path / "run", whole)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_run_after_the_unit_and_its_checkpoint(
    whole: Path, tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_unit = run_module._Run._log_unit

    def interrupt(self: Any, *arguments: Any) -> None:
        if self.position.unit == 3:
            os.kill(os.getpid(), number)
        log_unit(self, *arguments)

    monkeypatch.setattr(run_module._Run, "_log_unit", interrupt)
    rarely = replace(CONFIG, checkpoint_interval=1000.0)
    result = run(rarely, tmp_path / "run")
    monkeypatch.undo()
    assert (result.finished, result.signal) == (False, number)
    assert len(rows(tmp_path / "run")) == 4
    resumed = run(CONFIG, tmp_path / "run", resume=True)  # the interval may change
    assert (resumed.finished, resumed.signal) == (True, None)
    assert_same_run(tmp_path / "run", whole)


def test_the_second_signal_stops_at_once() -> None:
    before = signal.getsignal(signal.SIGINT)  # a job in the background ignores it
    with Interrupt() as interrupt:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


# ------------------------------------------------------------------------------------- refusing


def test_resuming_with_another_configuration_names_the_key(whole: Path) -> None:
    other = replace(CONFIG, policy=replace(CONFIG.policy, batch_size=9))
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


# ------------------------------------------------------------------------------------- checkpoints

META = {"task": "pendulum"}


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    shared = torch.rand(3)
    state = {
        "tensors": [shared, shared, torch.rand(4, 4).T, torch.tensor(True), torch.zeros(0, 2)],
        "numbers": (1, 2.5, None, True, float("inf"), "text"),
        3: {"nested": {"deep": torch.arange(3)}},
    }
    save_state(tmp_path / "state", state, metadata=META)
    assert_equal(load_state(tmp_path / "state", metadata=META), state)
    assert not [p for p in tmp_path.rglob("*") if p.suffix in (".pt", ".pkl", ".pickle")]


def test_what_is_no_data_is_refused_at_saving(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="object"):
        save_state(tmp_path / "state", {"a": object()}, metadata=META)
    assert not list(tmp_path.iterdir())


def corruptions() -> dict[str, Any]:
    def manifest(path: Path, change: Any) -> None:
        content = json.loads((path / "manifest.json").read_text())
        change(content)
        (path / "manifest.json").write_text(json.dumps(content))

    def file(path: Path, name: str) -> Path:
        return next(path.rglob(name))

    def truncate(path: Path, name: str) -> None:
        data = file(path, name).read_bytes()
        file(path, name).write_bytes(data[: len(data) // 2])

    def flip(path: Path) -> None:
        data = bytearray(file(path, "tensors.safetensors").read_bytes())
        data[-1] ^= 1
        file(path, "tensors.safetensors").write_bytes(bytes(data))

    def outside(content: dict[str, Any]) -> None:
        content["components"]["state"]["path"] = "../../elsewhere"

    return {
        "tensors cut": lambda p: truncate(p, "tensors.safetensors"),
        "tensors flipped": flip,
        "tensors gone": lambda p: file(p, "tensors.safetensors").unlink(),
        "tree cut": lambda p: truncate(p, "tree.json"),
        "tree of nonsense": lambda p: file(p, "tree.json").write_text('{"tree": {"eval": "1"}}'),
        "manifest cut": lambda p: truncate(p, "manifest.json"),
        "manifest gone": lambda p: (p / "manifest.json").unlink(),
        "manifest of nonsense": lambda p: (p / "manifest.json").write_text("[]"),
        "path outside": lambda p: manifest(p, outside),
        "other version": lambda p: manifest(p, lambda c: c["metadata"].update(format=99)),
        "other task": lambda p: manifest(p, lambda c: c["metadata"].update(task="acrobot")),
    }


@pytest.mark.parametrize("name", corruptions())
def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    rotation = CheckpointRotation(tmp_path / "checkpoints", keep_last=2, prefix="unit")
    for step in range(3):
        save_state(rotation, {"x": torch.full((64,), float(step))}, metadata=META, step=step)
    newest = rotation.checkpoints()[-1]
    corruptions()[name](newest)
    with pytest.raises(CheckpointError, match=newest.name):
        load_state(newest, metadata=META)
    with caplog.at_level(logging.WARNING):
        step, state = load_latest(rotation, metadata=META)
    assert (step, state["x"][0]) == (1, 1.0)
    assert newest.name in caplog.text
    corruptions()[name](rotation.checkpoints()[-1])
    with pytest.raises(CheckpointError, match="000000000001"):
        load_latest(rotation, metadata=META)


def test_a_run_survives_a_damaged_checkpoint(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = run_module._Run._save

    def crash(self: Any, *arguments: Any) -> None:
        save(self, *arguments)
        if self.position.unit == 4:
            raise Crash

    monkeypatch.setattr(run_module._Run, "_save", crash)
    with pytest.raises(Crash):
        run(CONFIG, tmp_path / "run")
    monkeypatch.undo()
    newest = sorted((tmp_path / "run" / "checkpoints").iterdir())[-1]
    next(newest.rglob("tensors.safetensors")).write_bytes(b"")
    assert run(CONFIG, tmp_path / "run", resume=True).finished
    assert_same_run(tmp_path / "run", whole)


def test_a_hostile_final_state_is_refused(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    run(replace(CONFIG, phases=("model",)), path)
    state = load_state(path / "phases" / "model", metadata={"task": CONFIG.task})
    state["trainer"]["dynamics"] = {"residual.0.weight": torch.zeros(1)}
    save_state(path / "phases" / "model", state, metadata={"task": CONFIG.task})
    with pytest.raises(CheckpointError, match="does not fit"):
        run(replace(CONFIG, phases=("model",)), path, resume=True)


# ------------------------------------------------------------------------------------- logs


def test_the_table_grows_columns_and_forgets_rows(tmp_path: Path) -> None:
    table = MetricsTable(tmp_path / "metrics.csv")
    table.append({"unit": 0, "a": 1.0})
    before = table.path.read_text()
    table.append({"unit": 1, "a": 2.0, "b": 3.0})
    MetricsTable(table.path, rows=1)
    assert table.path.read_text() == before


@pytest.mark.parametrize("cause", ["absent", "without a key", "tensorboard absent"])
def test_a_logger_that_fails_gives_way_to_the_csv(
    cause: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    config = LoggerConfig(name="wandb", mode="online")
    if cause == "absent":
        monkeypatch.setitem(sys.modules, "wandb", None)
    elif cause == "without a key":
        pytest.importorskip("wandb")
        for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
        monkeypatch.setenv("WANDB_CONFIG_DIR", str(tmp_path))
        monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("it asked a question"))
    else:
        config = LoggerConfig(name="tensorboard")
        monkeypatch.setattr("torchrl.record.loggers.tensorboard._has_tb", False)
    with caplog.at_level(logging.WARNING):
        logger = make_logger(config, {}, tmp_path)
    assert type(logger) is RunLogger
    assert f"logger={config.name}" in caplog.text
    logger.log({"real_steps": 1}, 0)
    logger.close()


def test_a_logger_that_fails_later_does_not_end_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(RunLogger):
        def log(self, metrics: Any, unit: int) -> None:
            raise OSError("the network is gone")

    monkeypatch.setattr(run_module, "make_logger", lambda *_, **__: Broken())
    assert run(replace(CONFIG, phases=("model",)), tmp_path / "run").finished
    assert "the network is gone" in caplog.text


class FakeRun:
    """What the logger uses of a wandb run."""

    id = "abc"

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, Any]] = {}
        self.axes: list[Any] = []

    def define_metric(self, name: str, step_metric: str | None = None) -> None:
        self.axes.append((name, step_metric))

    def log(self, row: dict[str, Any], step: int) -> None:
        self.rows.setdefault(step, {}).update(row)

    def log_artifact(self, artifact: Any) -> None:
        self.artifact = artifact

    def finish(self) -> None:
        self.finished = True


def test_wandb_gets_everything_and_goes_on_with_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = pytest.importorskip("wandb")
    options: list[dict[str, Any]] = []
    fake = FakeRun()
    monkeypatch.setattr(wandb, "init", lambda **kwargs: options.append(kwargs) or fake)
    config = replace(CONFIG, logger=LoggerConfig(name="wandb", mode="offline", tags=("t",)))
    run(replace(config, phases=("model", "policy")), tmp_path / "run")
    assert options[0]["mode"] == "offline"
    assert options[0]["config"]["policy"]["td3"]["gamma"] == 0.99
    assert options[0]["id"] is None
    assert fake.axes == [("real_steps", None), ("*", "real_steps")]
    assert sorted(fake.rows) == list(range(5))
    assert fake.rows[0]["real_steps"] == 30
    last = replace(config, phases=("evaluate",), start_from=str(tmp_path / "run"))
    run(last, tmp_path / "last")
    assert fake.artifact.type == "agent"
    assert "evaluate/episode.png" in fake.rows[7]
    logger = make_logger(config.logger, {}, tmp_path, run_id="abc", resume_unit=3)
    assert options[-1]["id"] == logger.id == "abc"
    assert options[-1]["resume"] == "allow"


def test_tensorboard_logs_and_forgets(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = LoggerConfig(name="tensorboard")
    for units, resume in ((range(5), None), (range(3, 6), 3)):
        logger = make_logger(config, {}, tmp_path, resume_unit=resume)
        for unit in units:
            logger.log({"real_steps": unit, "phase": "model", "x": 1.0}, unit)
        logger.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("x")] == list(range(6))


# Compiled


def test_no_graph_breaks_and_none_is_compiled_twice(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A whole run; a break would fail it, for every graph is a full one."""
    compile = torch.compile

    def aot_compile(function: Any, *, fullgraph: bool, dynamic: bool, **_: Any) -> Any:
        return compile(function, fullgraph=fullgraph, dynamic=dynamic, backend="aot_eager")

    monkeypatch.setattr(torch, "compile", aot_compile)
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    config = replace(CONFIG, compile=True, evaluate=replace(CONFIG.evaluate, latency_actions=2))
    with torch._dynamo.config.patch(error_on_recompile=True):
        assert run(config, tmp_path / "compiled").finished
    counters = torch._dynamo.utils.counters
    assert not counters["graph_break"]
    # The TD3 step, imagined chunks, returns in model and world, and plans for 2 worlds and for one.
    assert counters["stats"]["unique_graphs"] == 6
    for ours, eager in zip(rows(tmp_path / "compiled"), rows(whole), strict=True):
        for key, value in eager.items():
            if value and key != "phase":
                assert float(ours[key]) == pytest.approx(float(value), rel=1e-3, abs=1e-3), key
