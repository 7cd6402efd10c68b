"""At run time: references from the caller, kept and refused, and the estimate of a disturbance."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from phihp_torchrl import Agent, load_agent, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.dynamics import HybridDynamics
from tests.followed import AIM, Mass, disturbed, followed


class Shown(nn.Module):
    """An actor that does nothing, and keeps what it was shown."""

    in_keys, out_keys = ["observation"], ["action"]

    def forward(self, tensordict):
        self.seen = tensordict["observation"].clone()
        return tensordict.set("action", torch.zeros(*tensordict.batch_size, 1))


def see(agent, batch=(), **given):
    given = {"observation": torch.zeros(*batch, 2), **given}
    agent(TensorDict(given, batch_size=batch))
    return agent.actor.seen[..., 2:].tolist()


def test_a_reference_is_read_and_kept_until_another_is_given():
    agent = Agent(followed(), actor=Shown())
    assert see(agent, reference=torch.tensor([0.5])) == [0.5]
    assert see(agent) == [0.5]
    assert see(agent, reference=torch.tensor([-0.25])) == [-0.25]


def test_a_preview_is_read_and_moves_up():
    agent = Agent(followed(reference=replace(AIM, preview=2)), actor=Shown())
    whole = torch.tensor([[0.25], [0.5], [0.75]])
    assert see(agent, reference=whole) == [0.25, 0.5, 0.75]
    assert see(agent) == [0.5, 0.75, 0.75]
    assert see(agent, reference=torch.tensor([0.125])) == [0.125] * 3


def test_inputs_are_read_by_their_key():
    agent = Agent(followed(Mass()), actor=Shown())
    given = {"reference": torch.tensor([0.5]), "inputs": torch.tensor([1.0])}
    assert see(agent, **given) == [0.5, 0.5]  # the wind in half-ranges, and the reference
    with pytest.raises(ValueError, match=r"^inputs: expected"):
        see(agent, reference=given["reference"], is_init=torch.tensor([True]))


def test_a_missing_reference_is_refused_by_its_key_at_the_start_alone():
    agent = Agent(followed(), actor=Shown())
    with pytest.raises(ValueError, match=r"^reference: expected \('x',\) of shape \[1\] where"):
        see(agent)
    see(agent, reference=torch.tensor([0.5]))
    agent.reset()
    with pytest.raises(ValueError, match=r"^reference: "):
        see(agent)


def test_an_episode_that_starts_in_one_row_needs_it():
    agent = Agent(followed(), actor=Shown())
    see(agent, (2,), reference=torch.tensor([[0.5], [0.25]]))
    starts = torch.tensor([[False], [True]])
    with pytest.raises(ValueError, match=r"^reference: "):
        see(agent, (2,), is_init=starts)


def test_an_observation_with_the_reference_needs_no_key():
    agent = Agent(followed(), actor=Shown())
    assert see(agent, observation=torch.tensor([0.0, 0.0, 0.75])) == [0.75]


def test_values_beyond_those_of_training_are_doubted_once(caplog):
    agent = Agent(followed(), actor=Shown())
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            see(agent, reference=torch.tensor([1.5]))
    assert [r.message[:28] for r in caplog.records] == ["reference has values beyond "]


def play(agent, task, steps, push=0.0, batch=()):
    """States ``[steps, 2]`` of a mass that is pushed by a force which nobody tells the agent."""
    step = HybridDynamics.pure_prior(task).step
    state, states = torch.zeros(*batch, 2), []
    for k in range(steps):
        given = {"reference": torch.full([*batch, 1], 0.5)} if k == 0 else {}
        data = TensorDict(observation=state, is_init=torch.full([*batch, 1], k == 0), **given)
        action = agent(data.auto_batch_size_(len(batch)))["action"]
        state = step(state, action + push)
        states.append(state)
    return torch.stack(states)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_the_estimate_of_a_constant_disturbance_converges(batch):
    task = disturbed()
    agent = Agent(task, actor=Shown(), dynamics=HybridDynamics.pure_prior(task))
    play(agent, task, 40, push=1.25, batch=batch)
    estimate = agent._memory.estimate
    assert estimate.shape == (*batch, 1)
    assert torch.allclose(estimate, torch.full_like(estimate, 1.25), atol=1e-3)
    # The actor sees it in units of its range.
    assert agent.actor.seen[..., -1].sub(1.25 / 3.0).abs().max() < 1e-3


def test_a_wrong_load_is_a_disturbance_too():
    task = disturbed()
    agent = Agent(
        task, actor=Shown(), dynamics=HybridDynamics.pure_prior(task, constants={"mass": 0.5})
    )
    play(agent, task, 40, push=1.0)  # of which the model thinks nothing, for it commands nothing
    assert agent._memory.estimate.item() == pytest.approx(1.0, abs=1e-3)


def test_an_estimate_stays_in_its_range_and_starts_anew():
    task = disturbed()
    agent = Agent(task, actor=Shown(), dynamics=HybridDynamics.pure_prior(task))
    play(agent, task, 40, push=4.5)
    assert agent._memory.estimate.item() == 3.0
    play(agent, task, 1, push=4.5)
    assert agent._memory.estimate.item() == 0.0


class Spring(Shown):
    """Draws the mass to the reference, and holds against what the estimate says."""

    def forward(self, tensordict):
        x, x_dot, reference, *estimate = tensordict["observation"].unbind(-1)
        drift = 3.0 * estimate[0] if estimate else 0.0
        force = 4.0 * (reference - x) - 3.0 * x_dot - drift
        return tensordict.set("action", force.unsqueeze(-1))


@pytest.mark.parametrize("mass", [1.0, 2.5])  # the world's, where the model has 1
def test_there_is_no_steady_error_with_an_estimate(mass):
    def steady_error(task):
        agent = Agent(task, actor=Spring(), dynamics=HybridDynamics.pure_prior(task))
        world = HybridDynamics.pure_prior(task, constants={"mass": mass}).step
        state = torch.zeros(2)
        for k in range(300):
            data = TensorDict(observation=state, reference=torch.tensor([0.5]))
            data["is_init"] = torch.tensor([k == 0])
            state = world(state, agent(data)["action"] + 1.5)
        return (state[0] - 0.5).abs().item()

    assert steady_error(disturbed()) < 1e-3
    assert steady_error(followed()) == pytest.approx(1.5 / 4.0, abs=1e-3)


def test_the_agent_on_disk_refuses_a_task_with_another_reference(tmp_path):
    task = disturbed()
    save_agent(Agent(task, actor=Actor(task)), tmp_path)
    assert load_agent(tmp_path, task=task).task == task
    wider = replace(AIM, high=(2.0,))
    with pytest.raises(AgentError, match="expected the reference, inputs and disturbance"):
        load_agent(tmp_path, task=disturbed(reference=wider))
