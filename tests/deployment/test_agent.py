"""What agents do, and what they need for it."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from lopsided import LOPSIDED
from spawned import send
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch.nn import Linear

from phihp_torchrl import Agent, CEMPlanner, HybridDynamics, MPPIPlanner, get_task
from phihp_torchrl.agents import Actor, make_actor
from phihp_torchrl.baselines import LQI, PID
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.worlds import SimulatedWorld
from tests.followed import followed

from .agent_parts import SMALL, act, make_agent, observations


@pytest.mark.parametrize("batch", [[], [5], [2, 3]])
@pytest.mark.parametrize("task", ["pendulum", "acrobot-swingup", LOPSIDED])
def test_actions_in_bounds_for_any_batch(task, batch):
    agent = make_agent(task)
    bounds = agent.task.bounds
    td = observations(agent, batch)
    for policy in (agent, agent.actor_alone()):
        action = policy(td.clone())["action"]
        assert action.shape == (*batch, agent.task.action_dim)
        assert (action >= bounds.low).all()
        assert (action <= bounds.high).all()
        assert not action.requires_grad


def test_the_actor_alone_is_the_actor():
    agent = make_agent()
    td = observations(agent, [4])
    alone = agent.actor_alone()
    assert alone.planner is None
    assert alone.planner_config == SMALL
    assert torch.equal(act(alone, td), agent.actor.module(td["observation"]))
    assert not torch.equal(act(agent, td), act(alone, td))
    with torch.no_grad():
        agent.actor.module.mlp[-1].bias.add_(1.0)
    assert torch.equal(act(alone, td), agent.actor.module(td["observation"])), "parts are shared"


def test_an_agent_plans_by_other_numbers_on_the_same_modules():
    agent = make_agent(metadata={"seed": 3})
    td = observations(agent, [4])
    short = agent.with_planner(replace(SMALL, planning_horizon=1))
    assert short.planner.settings.planning_horizon == 1
    assert short.planner_config == replace(SMALL, planning_horizon=1)
    assert not torch.equal(act(short, td), act(agent, td))
    assert torch.equal(act(short.with_planner(SMALL), td), act(agent, td))
    by_mppi = agent.with_planner(MPPIConfig(num_candidates=16, top_k=4, num_policy_candidates=4))
    assert type(by_mppi.planner) is MPPIPlanner
    assert type(agent.planner) is CEMPlanner
    for other in (short, by_mppi):
        assert other.metadata == {"seed": 3}
        for name, module in agent.modules_by_name().items():
            assert other.modules_by_name()[name] is module


def test_an_agent_says_what_it_is_made_of():
    agent = make_agent()
    assert agent.kind == "phihp"
    assert list(agent.modules_by_name()) == ["dynamics", "actor", "qvalue"]
    config = agent.config
    assert config["actor"] == {"kind": "mlp_actor", "hidden_sizes": [8, 8]}
    assert config["qvalue"] == {"kind": "twin_q", "hidden_sizes": [8, 8]}
    assert config["dynamics"]["integrator"] == {"name": "semi_implicit_euler", "substeps": 1}
    assert config["planner"]["kind"] == "cem"
    assert config["planner"]["num_candidates"] == 16
    alone = Agent(agent.task, actor=make_actor(agent.task, (4,)))
    assert alone.config == {"actor": {"kind": "mlp_actor", "hidden_sizes": [4]}, "planner": None}


def test_an_agent_is_made_of_what_it_says():
    agent = make_agent()
    parts = Agent.build_modules(agent.task, agent.config)
    for name, module in agent.modules_by_name().items():
        parts[name].load_state_dict(module.state_dict())
    again = Agent.from_config(agent.task, agent.config, parts)
    td = observations(agent, [4])
    assert torch.equal(act(again, td), act(agent, td))
    assert again.config == agent.config


def test_an_agent_forgets_its_plan_on_reset():
    agent = make_agent(config=replace(SMALL, replan_every=3))
    td = observations(agent, [2])
    agent(td.clone())
    assert agent.planner.receding._plans is not None
    agent.reset()
    assert agent.planner.receding._plans is None
    agent.actor_alone().reset()


@pytest.mark.parametrize("kind", [LQI, PID])
def test_an_actor_with_a_memory_forgets_it_on_reset(kind):
    task = followed()
    agent = Agent(task, actor=kind.from_model(task, HybridDynamics.pure_prior(task)))
    shown = TensorDict(observation=torch.tensor([0.02, 0.0]), reference=torch.zeros(1))
    first, second = (agent(shown.clone())["action"] for _ in range(2))
    assert first != second  # the integral has grown
    agent.reset()
    assert agent(shown.clone())["action"] == first


class Counting(TensorDictModuleBase):
    """An actor that says how many steps it has acted since it was reset."""

    def __init__(self, *keys):
        super().__init__()
        self.in_keys, self.out_keys, self.steps = ["observation", *keys], ["action"], 0

    def forward(self, tensordict):
        self.steps += 1
        return tensordict.set("action", torch.zeros(1))

    def reset(self):
        self.steps = 0


def test_an_actor_that_reads_where_episodes_start_is_reset_and_no_network_is():
    task = get_task("pendulum")
    for actor, steps in ((Counting("is_init"), 0), (Counting(), 1)):
        agent = Agent(task, actor=actor)
        agent(TensorDict(observation=torch.tensor([1.0, 0.0, 0.0])))
        agent.reset()
        assert actor.steps == steps
    network = Linear(4, 1)
    network.reset = Mock()
    for keys in (["observation"], ["observation", "is_init"]):
        Agent(task, actor=TensorDictModule(network, keys, ["action"])).reset()
    network.reset.assert_not_called()


def test_an_agent_needs_enough_parts():
    task = get_task("pendulum")
    with pytest.raises(ValueError, match="actor: expected"):
        Agent(task)
    with pytest.raises(ValueError, match="dynamics: expected a model"):
        Agent(task, actor=Actor(task, (4,)), planner_config=SMALL)
    with pytest.raises(ValueError, match="actor: expected a module"):
        Agent(task, dynamics=SimulatedWorld(task).oracle(), planner_config=SMALL)
    plain = Agent(
        task,
        dynamics=SimulatedWorld(task).oracle(),
        planner_config=replace(SMALL, num_policy_candidates=0),
    )
    assert plain(observations(plain, [2]))["action"].shape == (2, 1)


@pytest.mark.parametrize("planner", [True, False])
def test_bad_observations_are_named(planner):
    agent = make_agent() if planner else make_agent().actor_alone()
    for bad in (
        torch.zeros(3, 2),
        torch.zeros(3, 3, dtype=torch.float64),
        torch.zeros(3, 3, device="meta"),
        torch.full((3, 3), torch.nan),
    ):
        with pytest.raises(ValueError, match=r"^observation: expected"):
            agent(TensorDict({"observation": bad}, batch_size=[3]))
    with pytest.raises(ValueError, match="observation: expected"):
        agent(TensorDict(batch_size=[3]))


def test_keys_out_and_spec_are_those_of_a_tensordict_module():
    task = get_task("pendulum")
    agent = Agent(task, actor=Actor(task))
    given = TensorDict(observation=task.observe(task.reset.sample([2])), batch_size=[2])
    out = TensorDict(batch_size=[2])
    assert agent(given, tensordict_out=out) is out
    assert list(given.keys()) == ["observation"]
    assert torch.equal(out["action"], agent(given.clone())["action"])
    assert agent.spec["action"].is_in(out["action"][0])
    assert agent.in_keys == ["observation"]
    warm = CEMConfig(planning_horizon=2, num_policy_candidates=0, warm_start=True)
    planning = Agent(task, dynamics=HybridDynamics.hybrid(task), planner_config=warm)
    assert planning.in_keys == ["observation", "is_init"]
    assert torch.equal(send(planning).spec["action"].high, torch.tensor([2.0]))
