"""Networks without the calls of modules are the same functions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from phihp_torchrl import Agent, get_task
from phihp_torchrl.agents import Actor, TwinQ


def lopsided():
    return replace(get_task("acrobot-swingup"), action_low=(-1.0, -3.0), action_high=(2.0, 1.0))


@pytest.mark.parametrize("rows", [(), (7,)])
def test_the_prepared_actor_is_the_actor(rows):
    actor = Actor(lopsided(), (16, 8))
    observation = torch.randn(*rows, 6)
    prepared = actor.prepared()
    with torch.no_grad():
        torch.testing.assert_close(prepared(observation), actor(observation))
        for parameter in actor.parameters():
            parameter.mul_(1.5)
        torch.testing.assert_close(prepared(observation), actor(observation))


@pytest.mark.parametrize("reduced", [False, True])
def test_the_prepared_critics_are_the_critics(reduced):
    critics = TwinQ(lopsided(), (16, 8))
    observation, action = torch.randn(7, 6), torch.randn(7, 2)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        found = critics.prepared()(observation, action)
        torch.testing.assert_close(found, critics(observation, action))


def test_the_evaluated_actor_is_the_actor():
    actor = Actor(lopsided(), (16, 8))
    observation = torch.randn(6)
    kept = observation.clone()
    with torch.no_grad():
        torch.testing.assert_close(actor.evaluate(observation), actor(observation))
        actor.mlp[2].weight = nn.Parameter(torch.randn(8, 16))  # another in its place
        torch.testing.assert_close(actor.evaluate(observation), actor(observation))
        assert torch.equal(observation, kept)
        assert actor.evaluate(observation[None]) is None
        actor.mlp[1] = nn.Tanh()
        assert actor.evaluate(observation) is None
        assert actor.prepared() is actor


def test_hooks_are_called_when_the_actor_acts_alone():
    task = lopsided()
    agent = Agent(task, actor=Actor(task, (16, 8)))
    data = TensorDict(observation=torch.randn(6))
    expected = agent.actor.module(data["observation"])
    assert torch.allclose(agent(data.clone())["action"], expected)
    for part in (agent.actor, agent.actor.module, agent.actor.module.mlp[0]):
        calls = []
        handle = part.register_forward_hook(lambda *_, calls=calls: calls.append(0))
        assert torch.allclose(agent(data.clone())["action"], expected)
        handle.remove()
        assert calls == [0]
