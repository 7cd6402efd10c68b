"""An agent whose plans leave what is near the goal to a regulator."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, get_task, load_agent, save_agent
from phihp_torchrl.baselines import Catch, Settle
from phihp_torchrl.deployment import AgentError, ExportedAgent, PlanModule
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld
from tests.followed import followed

from .agent_parts import SMALL, edit_json, edit_weights, make_agent

TASK = get_task("pendulum-swingup")
NEAR, FAR = torch.tensor([0.01, 0.0]), torch.tensor([3.0, 0.0])


@pytest.fixture
def agent() -> Agent:
    torch.manual_seed(0)
    made = make_agent(TASK)
    made.catch = Catch.from_model(TASK, made.dynamics)
    return made


def seen(*states, starts=None):
    state = torch.stack(states)
    keys = {} if starts is None else {"is_init": torch.tensor(starts)[:, None]}
    return TensorDict(observation=TASK.observe(state), **keys, batch_size=[len(states)])


def counted(agent, monkeypatch):
    """The batch sizes of the plans that are sought."""
    plans = []
    planning = type(agent.planner).planning

    def count(self, tensordict, *args):
        plans.append(len(tensordict))
        return planning(self, tensordict, *args)

    monkeypatch.setattr(type(agent.planner), "planning", count)
    return plans


def test_the_regulator_acts_near_the_goal_and_the_plan_elsewhere(agent, monkeypatch):
    plans = counted(agent, monkeypatch)
    torch.manual_seed(0)
    action = agent(seen(NEAR, FAR))["action"]
    torch.manual_seed(0)
    planned = agent.with_planner(SMALL)
    planned.catch = None
    expected = planned(seen(NEAR, FAR))["action"]
    assert torch.equal(action[1], expected[1])
    assert torch.equal(action[0], agent.catch.act(NEAR))
    assert plans == [2, 2]


def test_no_plan_is_sought_where_all_rows_are_near(agent, monkeypatch):
    plans = counted(agent, monkeypatch)
    agent(seen(NEAR, NEAR, starts=[True, False]))
    assert plans == [2], "an episode starts, and the planner has to know"
    for _ in range(3):
        action = agent(seen(NEAR, NEAR, starts=[False, False]))["action"]
    assert plans == [2]
    assert torch.equal(action, agent.catch.act(torch.stack([NEAR, NEAR])))


def test_plans_go_on_after_the_regulator_as_after_others():
    """The plan has moved up by the steps between, and what was sent last is the regulator's."""
    settings = replace(SMALL, warm_start=True, change_cost=1.0)
    agent = make_agent(TASK, settings)
    agent.catch = Catch.from_model(TASK, agent.dynamics)
    agent(seen(FAR, starts=[True]))
    receding = agent.planner.receding
    plan = receding._plans.clone()
    agent(seen(NEAR, starts=[False]))
    agent(seen(NEAR, starts=[False]))
    assert torch.equal(receding.last_action(None, torch.zeros(1, 1)), agent.catch.act(NEAR[None]))
    cold = torch.zeros_like(plan)
    moved = receding.recall(None, cold)
    assert torch.equal(moved[:, :1], cold[:, :1])  # three steps have passed, as many as it has
    assert settings.planning_horizon == 3


def test_the_actor_alone_has_no_regulator(agent):
    alone = agent.actor_alone()
    network = alone.actor.module
    assert torch.equal(alone(seen(NEAR))["action"], network(TASK.observe(NEAR[None])))


def test_it_is_saved_and_loaded_with_the_agent(agent, tmp_path):
    save_agent(agent, tmp_path)
    loaded = load_agent(tmp_path)
    assert loaded.catch is not None
    for name, buffer in agent.catch.state_dict().items():
        assert torch.equal(loaded.catch.state_dict()[name], buffer), name
    torch.manual_seed(0)
    expected = agent(seen(NEAR, FAR))["action"]
    torch.manual_seed(0)
    assert torch.equal(loaded(seen(NEAR, FAR))["action"], expected)


def test_a_regulator_of_another_size_is_refused(agent, tmp_path):
    save_agent(agent, tmp_path)
    edit_weights(tmp_path, lambda weights: weights.update({"catch.gain": torch.zeros(1, 3)}))
    with pytest.raises(AgentError, match=r"catch\.gain"):
        load_agent(tmp_path)


@pytest.mark.parametrize("shape", [[1, 2], [1]])
def test_an_observation_of_another_shape_is_an_error_that_says_so(agent, shape):
    given = TensorDict(observation=torch.zeros(shape), batch_size=shape[:-1])
    with pytest.raises(ValueError, match="observation"):
        agent(given)


@pytest.mark.parametrize(
    "observation", [torch.full((1, 3), torch.nan), torch.ones(1, 3, dtype=torch.float64)]
)
def test_the_regulator_is_not_asked_about_an_observation_that_a_plan_refuses(agent, observation):
    agent(seen(NEAR, starts=[True]))
    with pytest.raises(ValueError, match="observation"):
        agent(TensorDict(observation=observation, batch_size=[1]))


def test_an_exported_plan_has_the_regulator(agent):
    module = PlanModule(agent)
    noise = torch.randn(module.noise_shape)
    near, far = module(TASK.observe(NEAR), noise), module(TASK.observe(FAR), noise)
    assert not torch.allclose(far, agent.catch.act(FAR))
    assert torch.allclose(near, agent.catch.act(NEAR))
    exported = ExportedAgent(module, TASK, module.noise_shape)
    torch.manual_seed(0)
    far = exported(TensorDict(observation=TASK.observe(FAR)))["action"]
    torch.manual_seed(0)
    assert torch.equal(far, agent(TensorDict(observation=TASK.observe(FAR)))["action"])


def test_a_regulator_of_an_unknown_kind_is_refused(agent, tmp_path):
    save_agent(agent, tmp_path)
    edit_json(tmp_path, lambda content: content["catch"].update(kind="other"))
    with pytest.raises(AgentError, match=r"catch\.kind: expected one of \['goal', 'settle'\]"):
        load_agent(tmp_path)


@pytest.fixture
def follower() -> Agent:
    torch.manual_seed(0)
    task = followed(max_steps=60)
    made = make_agent(task, replace(SMALL, warm_start=True))
    made.catch = Settle.from_model(task, made.dynamics)
    return made


def standing(task, position, reference, *, starts=False):
    state = task.with_signals(
        task.at_rest(torch.tensor([[position, 0.0]])), torch.tensor([[reference]])
    )
    return TensorDict(
        observation=task.observe(state), is_init=torch.tensor([[starts]]), batch_size=[1]
    )


def test_on_a_reference_that_stands_still_the_regulator_acts(follower, tmp_path):
    save_agent(follower, tmp_path)
    loaded = load_agent(tmp_path, task=follower.task)
    for agent in (follower, loaded):
        torch.manual_seed(0)
        first = agent(standing(agent.task, 0.5, 0.3, starts=True))["action"].clone()
        second = agent(standing(agent.task, 0.32, 0.3))["action"]
        assert torch.allclose(second, first, atol=1e-4), "it goes on from what was sent"
        assert agent.catch._near.item()
        assert not agent(standing(agent.task, 0.32, -0.3)).is_empty()
        assert not agent.catch._near.item()
        agent.reset()
        assert agent.catch._sent is None


def test_a_follower_is_exported_without_it_and_says_so(follower, caplog):
    assert PlanModule(follower).catch is None
    assert "stands still has a memory, and is left out" in caplog.text


def test_an_agent_with_it_plays_whole_episodes(follower):
    world = SimulatedWorld(follower.task, SimulatedConfig())
    found = evaluate(follower, follower.task, episodes=3, seed=1, world=world)
    assert found.returns.isfinite().all()
