"""The actor in C acts as torch's does, and keeps what is under way as the task does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl import Agent, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import ActorModule, export_c
from phihp_torchrl.tasks import Actuator
from tests.deployment.compiled_c import ask, lively, needs_cc, words


def run_c(source, observations):
    return ask(source, map(words, observations))


@needs_cc
@pytest.mark.parametrize("task", ["acrobot-swingup", LOPSIDED])
def test_the_actions_are_those_of_torch(task, tmp_path):
    task = task if task is LOPSIDED else get_task(task)
    module = ActorModule(lively(task))
    observations = task.observe((task.coverage or task.reset).sample([200]))
    with torch.no_grad():
        expected = module(observations)
    assert expected.std() > 0.1
    found = run_c(export_c(module, tmp_path / "actor.c"), observations)
    torch.testing.assert_close(found, expected, atol=1e-5 * float(task.bounds.scale.max()), rtol=0)


@needs_cc
@pytest.mark.parametrize(
    "actuator",
    [
        Actuator(delay_steps=2.0),
        Actuator(delay_steps=(1.25, 0.0), lag=(0.0, 0.1), slew=3.0, dead_zone=0.1, gain_low=0.7),
    ],
)
def test_what_is_under_way_is_kept(actuator, tmp_path):
    task = replace(get_task("acrobot-swingup"), actuator=actuator)
    agent = lively(task)
    observations = task.system.observe(task.reset.sample([60]))
    expected = torch.stack(
        [agent(TensorDict(observation=observation))["action"] for observation in observations]
    )
    found = run_c(export_c(ActorModule(agent), tmp_path / "actor.c"), observations)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@needs_cc
def test_what_is_not_finite_gives_rest(tmp_path):
    agent = lively(get_task("pendulum"))
    wrong = torch.tensor([[1.0, float("nan"), 0.0]])
    assert run_c(export_c(ActorModule(agent), tmp_path / "actor.c"), wrong).tolist() == [[0.0]]
    with torch.no_grad():  # hidden units overflow, and their sum is no number
        agent.actor.module.mlp[0].weight.mul_(3e38)
    far = torch.tensor([[0.0, 0.0, 3e38]])
    assert agent(TensorDict(observation=far[0]))["action"].isnan()
    assert run_c(export_c(ActorModule(agent), tmp_path / "far.c"), far).tolist() == [[0.0]]


def test_what_has_no_c_is_named(tmp_path):
    task = get_task("pendulum")
    agent = Agent(task, actor=Actor(task, (4,)))
    with pytest.raises(ValueError, match=r"^path: expected a name of a C function"):
        export_c(ActorModule(agent), tmp_path / "my-actor.c")
    agent.actor.module.mlp[1] = torch.nn.GELU()
    with pytest.raises(ValueError, match=r"^agent: expected linear layers .* got a GELU"):
        export_c(ActorModule(agent), tmp_path / "actor.c")
    with pytest.raises(ValueError, match=r"^agent: expected one with an actor"):
        ActorModule(Agent(task, actor=_reads_more()))


def _reads_more():
    from tensordict.nn import TensorDictModule

    return TensorDictModule(lambda o, r: o, ["observation", "reference"], ["action"])
