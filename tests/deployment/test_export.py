"""Exported planners act as the eager one does, and what has no such plan says why."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl import Agent, Constraint, get_task, save_agent
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.commands import export, main
from phihp_torchrl.commands.export import _available, _milliseconds
from phihp_torchrl.deployment import (
    ActorModule,
    AgentError,
    Controller,
    ExportedAgent,
    PlanModule,
    export_aoti,
    export_onnx,
    largest_differences,
    load_exported,
)
from phihp_torchrl.deployment.exported import _LOADERS
from phihp_torchrl.deployment.manifest import Manifest
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld
from tests.followed import AIM, followed

from .agent_parts import make_agent as make_small_agent
from .agent_parts import observations as observe
from .compiled_c import CC

TINY = CEMConfig(
    planning_horizon=2, optim_steps=2, num_candidates=8, top_k=2, num_policy_candidates=2
)
# For what takes a minute to compile: a plan of more steps goes the same way.
SMALLEST = replace(TINY, planning_horizon=1, optim_steps=1)


def make_agent(name="pendulum", config=TINY, **options):
    task = name if name is LOPSIDED else get_task(name)
    parts = {"actor": Actor(task, (8,)), "qvalue": TwinQ(task, (8,))}
    return make_small_agent(task, config, **{**parts, **options})


def observations(agent, count=20):
    return observe(agent, [count])["observation"]


@pytest.mark.parametrize("task", ["acrobot-swingup", LOPSIDED])
def test_module_is_the_planner(task):
    agent = make_agent(task)
    module = PlanModule(agent)
    noise = torch.randn(module.noise_shape)
    observation = observations(agent, 1)[0]
    data = agent.task.observe(agent.task.reset.sample([]))
    assert module.example()[0].shape == data.shape
    expected = agent.planner.planning(TensorDict(observation=observation), noise)
    with torch.no_grad():
        assert torch.equal(module(observation, noise), expected)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_aot_inductor(tmp_path):
    agent = make_agent(config=replace(SMALLEST, warm_start=True))
    module = PlanModule(agent)
    act = export_aoti(module, tmp_path / "plan.pt2")
    assert (tmp_path / "plan.pt2").is_file()
    assert largest_differences(act, module, observations(agent)).max() < 1e-4
    loaded = load_exported(tmp_path / "plan.pt2")
    assert loaded(TensorDict(observation=observations(agent, 1)[0]))["action"].shape == (1,)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_onnx(tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    agent = make_agent(config=replace(SMALLEST, warm_start=True, change_cost=0.5))
    module = PlanModule(agent)
    act = export_onnx(module, tmp_path / "plan.onnx")
    loaded = load_exported(tmp_path / "plan.onnx")
    for _ in range(2):
        action = loaded(TensorDict(observation=observations(agent, 1)[0]))["action"]
    assert action.shape == (1,)
    assert largest_differences(act, module, observations(agent)).max() < 1e-4


def test_onnx_without_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"phihp_torchrl\[onnx\]"):
        export_onnx(PlanModule(make_agent()), tmp_path / "plan.onnx")


def test_what_is_not_installed_is_no_format_by_default(monkeypatch, capsys):
    monkeypatch.setattr(
        sys.modules["phihp_torchrl.commands.export"], "find_spec", lambda name: None
    )
    assert _available() == ("aoti", "c")
    assert "phihp_torchrl[onnx]" in capsys.readouterr().out


def test_differences_are_found():
    agent = make_agent()
    module = PlanModule(agent)
    off = largest_differences(lambda o, n: module(o, n) + 0.5, module, observations(agent, 3))
    torch.testing.assert_close(off, torch.full((3,), 0.5))


def test_what_cannot_be_exported():
    with pytest.raises(ValueError, match=r"^agent: expected one with a planner"):
        PlanModule(make_agent(config=None))
    world = SimulatedWorld("pendulum", SimulatedConfig(integrator="dopri5"))
    with pytest.raises(ValueError, match=r"^agent: expected a model whose integrator compiles"):
        PlanModule(make_agent(dynamics=world.oracle()))


def test_a_plan_is_sought_at_every_step_and_says_so(caplog):
    PlanModule(make_agent())
    assert caplog.text == ""
    PlanModule(make_agent(config=replace(TINY, replan_every=2)))
    assert "replan_every = 2 has no effect" in caplog.text


WARM = replace(TINY, planning_horizon=3, warm_start=True, noise_beta=1.0, select="best")


@pytest.mark.parametrize(
    ("config", "kept"),
    [
        (WARM, ["plan"]),
        (replace(WARM, change_cost=0.5, keep_incumbent=True), ["plan", "last"]),
        (replace(TINY, change_cost=0.5), ["last"]),
    ],
)
@pytest.mark.parametrize("task", ["pendulum", LOPSIDED])
def test_an_exported_plan_goes_on_from_the_one_before_as_the_planner_does(config, kept, task):
    agent = make_agent(task, config)
    module = PlanModule(agent)
    assert module.input_names == ["observation", "noise", *kept]
    assert module.output_names == ["action", *(["next_plan"] if "plan" in kept else [])]
    exported = ExportedAgent(module, agent.task, module.noise_shape, module.memory)
    agent.reset()
    with torch.no_grad():
        for k, seen in enumerate(observations(agent, 6)):
            starts = torch.tensor([k in (0, 4)])
            if k == 2:  # others have acted meanwhile
                sent = torch.tensor(agent.task.action_high)
                agent.follow(sent, missed=2)
                exported.follow(sent, missed=2)
            actions = []
            for each in (agent, exported):
                torch.manual_seed(k)
                data = TensorDict(observation=seen, is_init=starts)
                actions.append(each(data)["action"])
            torch.testing.assert_close(*actions)


def test_a_description_says_what_is_kept(tmp_path):
    path = tmp_path / "plan.onnx"
    path.write_bytes(b"a model")
    module = PlanModule(make_agent(LOPSIDED, replace(WARM, change_cost=0.5)))
    Manifest.of(module, path).write(path)
    found = Manifest.read(path).starts()
    assert found["plan"].tolist() == [[3.0]] * 3  # the middle of the bounds
    assert found["last"].isnan().all()
    content = json.loads(path.with_name("plan.onnx.json").read_text())
    content["memory"]["plan"] = "all"
    path.with_name("plan.onnx.json").write_text(json.dumps(content))
    with pytest.raises(AgentError, match="memory: expected lists of numbers"):
        Manifest.read(path).starts()
    del content["memory"]  # as an earlier version wrote it
    path.with_name("plan.onnx.json").write_text(json.dumps(content))
    assert Manifest.read(path).starts() == {}


def test_the_command_says_what_failed(tmp_path, monkeypatch, capsys):
    save_agent(make_agent(), tmp_path / "agent")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    words = [f"agent={tmp_path / 'agent'}", f"out={tmp_path / 'out'}", "states=5"]
    with pytest.raises(SystemExit, match=r"^error: not written: plan\.onnx, actor\.onnx; "):
        main([*words, "formats=[onnx,c]"], command="export")
    output = capsys.readouterr().out
    assert output.count("onnx: not written: ImportError") == 2
    assert "| eager plan |" not in output  # with which nothing would be compared
    assert "| eager actor |" in output
    assert (tmp_path / "out" / "actor.c").is_file()


@pytest.mark.parametrize("word", ["format=c", "format=[c]", "formats=[c]"])
def test_the_command_writes_c_without_a_plan_and_says_so_as_it_goes(
    tmp_path, monkeypatch, capsys, word
):
    save_agent(make_agent(), tmp_path / "agent")
    words = [f"agent={tmp_path / 'agent'}", f"out={tmp_path / 'out'}", word]
    monkeypatch.setattr(PlanModule, "forward", None)  # nothing may call it
    timed, said = [], []

    def milliseconds(act, module, observations):
        said.append(capsys.readouterr().out)  # what is there when the first check begins
        timed.append(found := _milliseconds(act, module, observations))
        return found

    monkeypatch.setattr(export, "_milliseconds", milliseconds)
    main([*words, "states=60"], command="export")
    first, last, _ = said[0].splitlines()
    assert first == f"Writing actor.c to {tmp_path / 'out'}."
    assert last == f"{tmp_path / 'out' / 'actor.c'}: written"
    assert [len(each) for each in timed] == [50] * (1 if CC is None else 2)
    output = capsys.readouterr().out
    assert "plan" not in output
    assert CC is None or "| 0 of 60 |" in output


def test_the_command_refuses_a_format_that_no_part_has(tmp_path):
    save_agent(make_agent(), tmp_path / "agent")
    words = [f"agent={tmp_path / 'agent'}", f"out={tmp_path / 'out'}", "parts=[plan]"]
    with pytest.raises(SystemExit, match=r"formats: .* got \['c'\]; c is for the actor alone"):
        main([*words, "formats=[c]"], command="export")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_actor_as_onnx_is_loaded_again_where_it_fits(tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    agent = make_agent(LOPSIDED)
    module, path = ActorModule(agent), tmp_path / "actor.onnx"
    act = export_onnx(module, path)
    assert largest_differences(act, module, observations(agent)).max() < 1e-5
    with pytest.raises(AgentError, match="Register it first"):
        load_exported(path)
    loaded = load_exported(path, LOPSIDED)
    seen = observations(agent, 1)[0]
    found = loaded(TensorDict(observation=seen))["action"]
    torch.testing.assert_close(found, act(seen))
    assert Controller(loaded).step(seen).tolist() == found.tolist()
    with pytest.raises(ValueError, match=r"^observation: expected finite numbers of shape \[3\]"):
        loaded(TensorDict(observation=seen * torch.nan))
    with pytest.raises(AgentError, match=r"expected its time_step"):
        load_exported(path, replace(LOPSIDED, time_step=0.02))
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(AgentError, match="got another"):
        load_exported(path, LOPSIDED)


@pytest.fixture
def exported(tmp_path, monkeypatch):
    """Write an actor's description beside a file that stands for its model."""
    monkeypatch.setitem(_LOADERS, ".onnx", lambda path: torch.zeros_like)
    path = tmp_path / "actor.onnx"

    def write(task):
        path.write_bytes(b"a model")
        Manifest.of(ActorModule(Agent(task, actor=Actor(task, (8,)))), path).write(path)
        return path

    return write


def test_an_exported_file_has_what_its_agent_was_trained_with(exported):
    task = replace(
        get_task("pendulum"),
        actuator=Actuator(lag=0.1),
        action_rate_limit=2.0,
        action_rate_cost=0.5,
        constraints=(Constraint("theta_dot", high=4.0, price=1.0),),
    )
    path = exported(task)
    for wanted in (None, "pendulum", task):
        assert load_exported(path, wanted).task == task
    for name, other in (("action_rate_limit", 4.0), ("actuator", Actuator(lag=0.2))):
        with pytest.raises(AgentError, match=f"is another one here: expected its {name}"):
            load_exported(path, replace(task, **{name: other}))
    exported(get_task("pendulum"))
    assert load_exported(path).task is get_task("pendulum")


@pytest.mark.parametrize("other", [{"high": (2.0,)}, {"preview": 2}])
def test_an_exported_file_is_refused_for_another_reference(other, exported):
    task = followed()
    path = exported(task)
    assert load_exported(path, task).task is task
    with pytest.raises(AgentError, match="another one here: expected the reference"):
        load_exported(path, followed(reference=replace(AIM, **other)))


def test_a_description_of_version_1_says_nothing_of_limits(exported):
    task = followed(action_rate_limit=2.0, actuator=Actuator(lag=0.1))
    path = exported(task)
    place = path.with_name("actor.onnx.json")
    content = json.loads(place.read_text())
    added = content.pop("additions")
    old = {**content, "actuator": added["actuator"]}
    del old["format_version"]
    place.write_text(json.dumps(old))
    assert load_exported(path, task).task == task
    assert load_exported(path, replace(task, actuator=None)).task == task
    with pytest.raises(AgentError, match="expected observations of 5 numbers, got 4"):
        load_exported(path, replace(task, action_rate_limit=None))
    place.write_text(json.dumps({**content, "additions": added, "format_version": 3}))
    with pytest.raises(AgentError, match="expected format_version 1 or 2, got 3"):
        load_exported(path, task)


@pytest.mark.parametrize("task", [{}, {"name": 3}, 3, "x"])
def test_a_description_without_a_task_is_refused(task, exported):
    path = exported(get_task("pendulum"))
    place = path.with_name("actor.onnx.json")
    place.write_text(json.dumps({**json.loads(place.read_text()), "task": task}))
    with pytest.raises(AgentError):
        load_exported(path)


@pytest.mark.slow
def test_the_actor_as_onnx_runs_where_there_is_no_torch(tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    agent = make_agent()
    act = export_onnx(ActorModule(agent), tmp_path / "actor.onnx")
    seen = observations(agent, 1)[0]
    code = f"""
import sys
sys.modules["torch"] = None  # importing it fails
import numpy, onnxruntime
session = onnxruntime.InferenceSession({str(tmp_path / "actor.onnx")!r})
observation = numpy.array({seen.tolist()}, numpy.float32)
print(session.run(["action"], {{"observation": observation}})[0].tolist())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    torch.testing.assert_close(torch.tensor(json.loads(done.stdout)), act(seen))


def test_machine_code_for_another_machine_is_refused(tmp_path):
    path = tmp_path / "plan.pt2"
    path.write_bytes(b"code")
    manifest = Manifest.of(PlanModule(make_agent()), path)
    manifest.write(path)
    assert Manifest.read(path) == manifest
    manifest.check(path, machine_code=True)
    others = {"torch_version": "1.0", "platform": "Other cpu", "processor": ("avx9000",)}
    for name, value in others.items():
        replace(manifest, **{name: value}).write(path)
        with pytest.raises(AgentError, match="export the agent again on this machine"):
            load_exported(path)
    with pytest.raises(AgentError, match=r"expected one of \['.pt2', '.onnx'\]"):
        load_exported(tmp_path / "plan.pt2.json")
