"""Limits and prices of the action's rate in worlds, agents, files, recordings and runs."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, HybridDynamics, get_task, load_agent, load_config, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.recordings import Recording, transitions
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.trainers import CollectConfig, read_run_config
from phihp_torchrl.trainers.record import record
from phihp_torchrl.trainers.run_config import task_of
from phihp_torchrl.worlds import (
    EnvWorld,
    GymnasiumConfig,
    SimulatedConfig,
    SimulatedWorld,
    make_world,
)

LATE = Actuator(delay_steps=1.5, lag=0.04)


@pytest.fixture(params=[None, LATE], ids=["plain", "late"])
def task(request):
    changes = {"action_rate_limit": 10.0, "action_rate_cost": 5.0, "actuator": request.param}
    return replace(get_task("pendulum"), **changes)


def play(env, model, steps=20):
    """Step an environment and the model of its world; the commands, and the rewards of both."""
    task, data = model.task, env.reset()
    state, generator = task.locate(data["observation"]), torch.Generator().manual_seed(0)
    rewards, commands = [], []
    for _ in range(steps):
        action = 8.0 * torch.rand(1, generator=generator) - 4.0
        commands.append(task.command(task.split(state)[1], action))
        data = env.step(data.set("action", action))["next"]
        state, reward, _ = model.transition(state, action)
        torch.testing.assert_close(data["observation"], task.observe(state), rtol=0, atol=1e-5)
        rewards.append((data["reward"].item(), reward.item()))
        data = data.exclude("reward")
    return torch.stack(commands), torch.tensor(rewards)


def test_an_environment_moves_and_earns_as_the_model_of_its_world(task):
    world = SimulatedWorld(task)
    commands, rewards = play(world.make_env(), world.model())
    torch.testing.assert_close(rewards[:, 0], rewards[:, 1], rtol=0, atol=1e-4)
    assert commands.diff(dim=0).abs().max() <= 0.5 + 1e-6


def test_imagination_alone_pays_the_price(task):
    world = SimulatedWorld(task)
    imagined = TaskWorldModel(task, world.oracle())
    commands, rewards = play(world.make_env(), imagined)
    moves = torch.cat([torch.zeros(1, 1), commands]).diff(dim=0)[:, 0]
    paid = 5.0 * (moves / 2.0).square()
    torch.testing.assert_close(rewards[:, 0] - rewards[:, 1], paid, rtol=0, atol=1e-4)


def test_a_foreign_environment_gets_commands_within_the_rate():
    """The world's own limit of torque is wider, so that only the task holds it back."""
    task = replace(get_task("pendulum"), action_rate_limit=10.0)
    world = make_world(task, GymnasiumConfig("Pendulum-v1"))
    got = []

    class Seen(gymnasium.Wrapper):
        def step(self, action):
            got.append(float(action[0]))
            return super().step(action)

    env = EnvWorld(task, lambda: Seen(gymnasium.make("Pendulum-v1"))).make_env()
    rollout = env.rollout(8, lambda td: td.set("action", torch.tensor([2.0])))
    assert got == pytest.approx([0.5, 1.0, 1.5, 2.0, 2.0, 2.0, 2.0, 2.0])
    shown = rollout["next", "observation"][:, -1] * 2.0
    assert shown.tolist() == pytest.approx(got)
    assert rollout["action"].eq(2.0).all()  # what was asked for stays as it was
    assert world.make_env().rollout(2)["observation"].shape == (2, 4)


def test_an_agent_gives_the_command_that_the_world_gets(task):
    torch.manual_seed(0)
    agent = Agent(task, actor=Actor(task))
    with torch.no_grad():  # an actor that wants the upper bound
        agent.actor.module.mlp[-1].bias.add_(5.0)
    blind = SimulatedWorld(replace(get_task("pendulum"), actuator=task.actuator))
    env, got = blind.make_env(), []
    data = env.reset()
    agent.reset()
    for _ in range(6):
        seen = data["observation"][: task.system.observation_dim]
        action = agent(TensorDict(observation=seen))["action"]
        got.append(action.item())
        data = env.step(data.set("action", action))["next"].exclude("reward")
    assert got == pytest.approx([0.5, 1.0, 1.5, 2.0, 2.0, 2.0], abs=1e-3)


def test_an_agent_that_sees_its_registers_is_within_the_rate_too(task):
    agent = Agent(task, actor=Actor(task))
    with torch.no_grad():
        agent.actor.module.mlp[-1].bias.add_(5.0)
    state = torch.cat([torch.zeros(2, 3, 2), task.random_registers([2, 3])], -1)
    action = agent(TensorDict(observation=task.observe(state), batch_size=[2, 3]))["action"]
    expected = (state[..., -1:] + 0.5).clamp(max=2.0)
    torch.testing.assert_close(action, expected, rtol=0, atol=1e-3)


def test_the_memory_of_an_agent_is_that_of_its_world(task):
    torch.manual_seed(0)
    task = replace(task, max_steps=40)
    agent = Agent(task, actor=Actor(task))
    plain = replace(get_task("pendulum"), max_steps=40)  # which shows the system alone
    actuator = {} if task.actuator is None else task.actuator.config
    hidden = SimulatedWorld(plain, SimulatedConfig(actuator=actuator))
    blind = evaluate(agent, plain, episodes=2, env=hidden.make_env())
    seeing = evaluate(agent, task, episodes=2, env=SimulatedWorld(task).make_env())
    torch.testing.assert_close(blind.returns, seeing.returns, rtol=0, atol=1e-2)


def test_an_agent_is_saved_with_its_rates(task, tmp_path):
    agent = Agent(task, actor=Actor(task))
    save_agent(agent, tmp_path)
    loaded = load_agent(tmp_path)
    for name in ("action_rate_limit", "action_rate_cost", "actuator"):
        assert getattr(loaded.task, name) == getattr(task, name)
    observation = TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(
        loaded(observation.copy())["action"], agent(observation.copy())["action"]
    )
    with pytest.raises(AgentError, match="action_rate_limit"):
        load_agent(tmp_path, task=replace(task, action_rate_limit=1.0))


def test_a_recorded_log_leads_back_to_what_was_under_way(task, tmp_path):
    world = SimulatedWorld(task)
    path = record(world, CollectConfig(), 40, 0, tmp_path / "steps.csv")
    data = transitions(task, make_world(task, {"kind": "recorded", "files": str(path)}).recordings)
    env = world.make_env()
    assert len(data) == 40
    assert data["observation"].shape == (40, env.observation_spec["observation"].shape[-1])
    moves = data["action"].diff(dim=0).abs()
    assert 0.1 < moves.max() <= 0.5 + 1e-4
    shown = data["observation"][1:, -1:] * 2.0
    torch.testing.assert_close(shown, data["action"][:-1], rtol=0, atol=1e-5)


def test_commands_of_a_log_that_are_too_fast_are_left_out(caplog):
    task = replace(get_task("pendulum"), action_rate_limit=10.0)
    action = torch.tensor([[0.4], [0.8], [-1.0], [-1.2], [0.0]])
    log = Recording(0.05 * torch.arange(5), torch.zeros(5, 2), action)
    data = transitions(task, [log])
    assert data["action"].flatten().tolist() == pytest.approx([0.4, 0.8, -1.2])
    assert "action_rate_limit" in caplog.text


def test_a_run_sets_the_rates():
    settings = load_config(
        "acrobot-swingup",
        overrides=["action_rate_limit=[5,6]", "action_rate_cost=0.1", "actuator.delay_steps=1"],
    )
    task = task_of(read_run_config(settings))
    assert task.action_rate_limit == (5.0, 6.0)
    assert task.action_rate_cost == 0.1
    assert task.register_count == 4
    own = replace(get_task("pendulum"), action_rate_cost=0.2)
    plain = read_run_config(load_config("pendulum"))
    assert task_of(plain, own) is own
    free = read_run_config(load_config("pendulum", overrides=["action_rate_cost=0"]))
    assert task_of(free, own).action_rate_cost == 0.0


def test_a_step_with_rates_compiles_as_one_graph():
    task = replace(
        get_task("pendulum"), action_rate_limit=10.0, action_rate_cost=5.0, actuator=LATE
    )
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    compiled = torch.compile(model.transition, fullgraph=True, backend="eager")
    state = torch.cat([torch.zeros(5, 2), task.random_registers([5])], -1)
    with torch.no_grad():
        expected = model.transition(state, 3.0 * torch.ones(5, 1))
        for one, other in zip(compiled(state, 3.0 * torch.ones(5, 1)), expected, strict=True):
            torch.testing.assert_close(one, other)
