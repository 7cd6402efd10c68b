"""TD-MPC's agents: what they do, and that what is loaded is what was saved."""

from __future__ import annotations

import copy
import json

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl import load_agent, save_agent
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.planners import MPPIConfig
from phihp_torchrl.tasks import find_task
from phihp_torchrl.tdmpc import TOLD, TDMPCAgent, TOLDConfig

SMALL = TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8)
PLAN = MPPIConfig(
    planning_horizon=2, optim_steps=2, num_candidates=16, top_k=4, num_policy_candidates=3
)


def make_agent(task="cartpole", seed=0):
    torch.manual_seed(seed)
    task = find_task(task)
    return TDMPCAgent(task, TOLD.for_task(task, SMALL), PLAN, metadata={"seed": seed})


def situation(agent, *batch):
    generator = torch.Generator().manual_seed(0)
    state = agent.task.reset.sample([*batch], generator=generator)
    return TensorDict(observation=agent.task.observe(state), batch_size=batch)


def act(agent, td):
    torch.manual_seed(5)
    agent.reset()
    return agent(td.clone())["action"]


@pytest.mark.parametrize("task", ["cartpole", "pendulum-swingup", "acrobot-swingup"])
def test_a_saved_agent_acts_as_before(tmp_path, task):
    agent = make_agent(task)
    loaded = load_agent(save_agent(agent, tmp_path), task=task)
    assert isinstance(loaded, TDMPCAgent)
    assert loaded.metadata == {"seed": 0}
    td = situation(agent, 3, 2)
    assert torch.equal(act(loaded, td), act(agent, td))
    policy = load_agent(tmp_path, planner=False)
    assert policy.planner is None
    expected = agent.told.policy(agent.told.encode(td["observation"]))
    torch.testing.assert_close(policy(td.clone())["action"], expected)
    torch.testing.assert_close(agent.actor_alone()(td.clone())["action"], expected)


def test_a_copy_has_networks_of_its_own():
    agent = make_agent()
    other, td = copy.deepcopy(agent), situation(agent, 4)
    before = act(agent, td)
    assert torch.equal(act(other, td), before)
    with torch.no_grad():
        other.told.actor[-1].weight.add_(1.0)
        other.told.dynamics[-1].weight.mul_(3.0)
    assert torch.equal(act(agent, td), before)


def test_an_agent_forgets_where_an_episode_starts():
    agent = make_agent()
    td = situation(agent, 2)
    agent(td.clone())
    kept = agent.planner.receding.recall(None, torch.zeros(2, 2, 1))
    assert kept.any()
    cold = agent.planner.receding.recall(torch.tensor([True, False]), torch.zeros(2, 2, 1))
    assert torch.equal(cold, torch.stack([torch.zeros(2, 1), kept[1]]))


def test_a_policy_alone_keeps_its_planner_for_later(tmp_path):
    agent = make_agent()
    policy = agent.actor_alone()
    assert isinstance(policy, TDMPCAgent)
    assert policy.planner is None
    loaded = load_agent(save_agent(policy, tmp_path))
    assert loaded.planner_config == PLAN
    assert torch.equal(act(loaded, situation(agent, 3)), act(agent, situation(agent, 3)))
    never = TDMPCAgent(agent.task, agent.told)
    assert never.config["planner"] is None
    again = load_agent(save_agent(never, tmp_path))
    assert again.planner is None
    td = situation(agent, 3)
    assert torch.equal(act(again, td), act(policy, td))


def test_lopsided_bounds_are_kept(tmp_path):
    agent = make_agent(LOPSIDED)
    with torch.no_grad():
        agent.told.actor[-1].weight.mul_(1e3)
    td = situation(agent, 200)
    loaded = load_agent(save_agent(agent, tmp_path), task=LOPSIDED)
    for one, other in ((agent, loaded), (agent.actor_alone(), loaded.actor_alone())):
        action = act(one, td)
        assert torch.equal(act(other, td), action)
        assert action.min().item() == pytest.approx(-6.0)
        assert action.max().item() == pytest.approx(12.0)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("mlp_dim", 10**9, r"networks\.mlp_dim: expected at most 65536, got 1000000000"),
        ("mlp_dim", 16, r"expected torch\.float32 of shape"),
        ("mlp_dim", 0, r"networks\.mlp_dim: expected a whole number >= 1, got 0"),
        ("latent_dim", "4", r"networks\.latent_dim: expected a whole number, got '4'"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path, key, value, message):
    save_agent(make_agent(), tmp_path)
    path = tmp_path / "agent.json"
    content = json.loads(path.read_text())
    content["networks"][key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(AgentError, match=message):
        load_agent(tmp_path)


@pytest.mark.parametrize("planner", [True, False])
@pytest.mark.parametrize(
    "observation", [torch.zeros(2, 4), torch.full((2, 5), torch.nan), torch.zeros(2, 5).double()]
)
def test_a_bad_observation_is_named(planner, observation):
    agent = make_agent() if planner else make_agent().actor_alone()
    with pytest.raises(ValueError, match="observation: expected"):
        agent(TensorDict(observation=observation, batch_size=[2]))
