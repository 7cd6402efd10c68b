"""Exported planners act as the eager one does; control loops keep time or say that they do not."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.deployment import (
    Agent,
    PlanModule,
    export_aoti,
    export_onnx,
    largest_differences,
    run_realtime,
    save_agent,
)
from phihp_torchrl.planners.factory import PlannerConfig

RECIPES = Path(__file__).parents[1] / "recipes"
TINY = PlannerConfig(
    planning_horizon=2, optim_steps=2, num_candidates=8, top_k=2, num_policy_candidates=2
)


def make_agent(name="pendulum", **options):
    task = get_task(name)
    options = {"planner_config": TINY, "dynamics": HybridDynamics.hybrid(task), **options}
    return Agent(task, actor=Actor(task, (8,)), qvalue=TwinQ(task, (8,)), **options)


def observations(agent, count=20):
    return agent.task.system.observe(agent.task.coverage.sample([count]))


def run_recipe(monkeypatch, name, *arguments):
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(RECIPES / name), run_name="__main__")


# Exports


def test_module_is_the_planner():
    agent = make_agent("acrobot-swingup")
    module = PlanModule(agent)
    noise = torch.randn(module.noise_shape)
    observation = observations(agent, 1)[0]
    data = agent.task.system.observe(agent.task.reset.sample([]))
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
    task = get_task("pendulum")
    with pytest.raises(ValueError, match="with a planner"):
        PlanModule(make_agent(planner_config=None))
    dynamics = HybridDynamics.oracle(task, integrator="dopri5")
    with pytest.raises(ValueError, match="integrator"):
        PlanModule(make_agent(dynamics=dynamics))


def test_export_recipe_says_what_failed(tmp_path, monkeypatch, capsys):
    save_agent(make_agent(), tmp_path / "agent")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    arguments = ["--out", tmp_path / "out", "--formats", "onnx", "--states", 5]
    run_recipe(monkeypatch, "export.py", tmp_path / "agent", *arguments)
    output = capsys.readouterr().out
    assert "onnx: not written: ImportError" in output
    assert "| eager |" in output


# Control loops


class FakeTime:
    """A clock that only sleeping and acting move."""

    def __init__(self, durations):
        self.now, self.durations = 100.0, iter(durations)

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds

    def policy(self):
        def act(observation):
            self.now += next(self.durations)
            return torch.ones(1)

        return TensorDictModule(act, ["observation"], ["action"])


def test_deadlines():
    # At 10 Hz: in time, two and a half periods late, and in time again.
    time = FakeTime([0.01, 0.25, 0.02, 0.03, 0.01, 0.01])
    report = run_realtime(
        time.policy(),
        get_task("pendulum"),
        rate=10,
        seconds=0.6,
        clock=time.clock,
        sleep=time.sleep,
    )
    assert report.missed == 2
    # The action after the late one starts half a period after its tick.
    expected = [10.0, 250.0, 50.0 + 20.0 - 50.0, 30.0]
    assert report.milliseconds[:2].tolist() == pytest.approx(expected[:2])
    assert len(report.milliseconds) == 4
    assert time.now == pytest.approx(100.0 + 0.5 + report.milliseconds[-1].item() / 1e3)


def test_the_world_does_not_wait():
    """Late actions or not, the world has gone through the same time."""
    steps = []
    task = get_task("pendulum")

    def reward(state, action, next_state):
        steps.append(action.item())
        return torch.zeros(())

    time = FakeTime([0.25, 0.01, 0.01])
    run_realtime(
        time.policy(), replace(task, reward=reward), rate=10, seconds=0.5,
        clock=time.clock, sleep=time.sleep,
    )  # fmt: skip
    assert steps == [0.0, 0.0, 1.0, 1.0, 1.0], "the first two ticks had no action yet"


@pytest.mark.parametrize("name", ["rate", "seconds"])
def test_bad_rates(name):
    options = {"rate": 10.0, "seconds": 1.0, name: 0.0}
    with pytest.raises(ValueError, match=f"^{name}:"):
        run_realtime(FakeTime([]).policy(), get_task("pendulum"), **options)


def test_realtime_recipe(tmp_path, monkeypatch, capsys):
    save_agent(make_agent(), tmp_path / "agent")
    arguments = ["--rates", 20, "--seconds", 0.3, "--eager"]
    run_recipe(monkeypatch, "realtime.py", tmp_path / "agent", *arguments)
    assert "| 20 |" in capsys.readouterr().out
