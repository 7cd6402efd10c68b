"""Exported planners act as the eager one does, and what has no such plan says why."""

from __future__ import annotations

import sys

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl import get_task, save_agent
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.commands import main
from phihp_torchrl.deployment import (
    PlanModule,
    export_aoti,
    export_onnx,
    largest_differences,
)
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .agent_parts import make_agent as make_small_agent
from .agent_parts import observations as observe

TINY = CEMConfig(
    planning_horizon=2, optim_steps=2, num_candidates=8, top_k=2, num_policy_candidates=2
)


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
    agent = make_agent()
    module = PlanModule(agent)
    act = export_aoti(module, tmp_path / "plan.pt2")
    assert (tmp_path / "plan.pt2").is_file()
    assert largest_differences(act, module, observations(agent)).max() < 1e-4


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_onnx(tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    agent = make_agent()
    module = PlanModule(agent)
    act = export_onnx(module, tmp_path / "plan.onnx")
    assert largest_differences(act, module, observations(agent)).max() < 1e-4


def test_onnx_without_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"phihp_torchrl\[onnx\]"):
        export_onnx(PlanModule(make_agent()), tmp_path / "plan.onnx")


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


def test_the_command_says_what_failed(tmp_path, monkeypatch, capsys):
    save_agent(make_agent(), tmp_path / "agent")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    words = [f"agent={tmp_path / 'agent'}", f"out={tmp_path / 'out'}", "formats=[onnx]", "states=5"]
    main(words, command="export")
    output = capsys.readouterr().out
    assert "onnx: not written: ImportError" in output
    assert "| eager |" in output
