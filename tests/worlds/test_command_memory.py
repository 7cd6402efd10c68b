"""What is under way in an actuator: in environments, in the acting agent, and in files."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import SerialEnv

from phihp_torchrl import Agent, get_task, load_agent, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import EnvWorld, SimulatedConfig, SimulatedWorld

LATE = Actuator(delay_steps=1.5, lag=0.04)


@pytest.fixture
def task():
    return replace(get_task("pendulum"), actuator=LATE)


def test_an_environment_moves_as_the_model_of_its_world(task):
    world = SimulatedWorld(task)
    env, model = world.make_env(), world.model()
    data = env.reset()
    state = task.locate(data["observation"])
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        action = 4.0 * torch.rand(1, generator=generator) - 2.0
        data = env.step(data.set("action", action))["next"]
        state = model.transition(state, action).next_state
        torch.testing.assert_close(data["observation"], task.observe(state), rtol=0, atol=1e-5)
        data = data.exclude("reward")


def test_an_episode_starts_with_nothing_under_way(task):
    env = SimulatedWorld(replace(task, max_steps=4)).make_env()
    steps = env.rollout(12, break_when_any_done=False)
    registers = steps["observation"][:, task.system.observation_dim :]
    assert [i for i, row in enumerate(registers) if not row.any()] == [0, 4, 8]


def test_an_agent_remembers_what_the_environment_would_show(task):
    torch.manual_seed(0)
    agent = Agent(task, actor=Actor(task))
    hidden = SimulatedWorld(get_task("pendulum"), SimulatedConfig(actuator=LATE.config))
    shown = SimulatedWorld(task)
    blind = evaluate(agent, get_task("pendulum"), episodes=3, world=hidden)
    several = SerialEnv(3, shown.make_env)
    seeing = evaluate(agent, task, episodes=3, env=several)
    several.close()
    torch.testing.assert_close(blind.returns, seeing.returns)


def test_the_memory_of_a_batch_is_reset_row_by_row(task):
    agent = Agent(task, actor=Actor(task))
    shown = task.system.observe(torch.zeros(2, 2))
    agent(TensorDict(observation=shown, is_init=torch.ones(2, 1).bool(), batch_size=[2]))
    agent._memory._state = torch.ones(2, task.state_dim)
    starts = torch.tensor([[True], [False]])
    seen = agent._memory.extend(TensorDict(observation=shown, is_init=starts, batch_size=[2]))
    registers = seen["observation"][:, task.system.observation_dim :]
    assert not registers[0].any()
    assert registers[1].all()


def test_any_environment_gets_the_memory(task):
    world = EnvWorld(task, SimulatedWorld(get_task("pendulum")).make_env)
    assert world.make_env().rollout(3)["observation"].shape == (3, task.observation_dim)
    ready = EnvWorld(task, SimulatedWorld(task).make_env)  # which shows it by itself
    assert ready.make_env().rollout(3)["observation"].shape == (3, task.observation_dim)


def test_a_world_with_another_actuator_is_no_model_of_the_task():
    late = SimulatedWorld("pendulum", SimulatedConfig(actuator={"delay_steps": 1}))
    assert late.model() is None
    assert SimulatedWorld("pendulum").model() is not None


def test_an_agent_is_saved_with_its_actuator(task, tmp_path):
    agent = Agent(task, actor=Actor(task))
    save_agent(agent, tmp_path)
    loaded = load_agent(tmp_path)
    assert loaded.task.actuator == LATE
    observation = TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(
        loaded(observation.copy())["action"], agent(observation.copy())["action"]
    )
    other = replace(task, actuator=Actuator(delay_steps=3.0))
    with pytest.raises(AgentError, match="actuator"):
        load_agent(tmp_path, task=other)
