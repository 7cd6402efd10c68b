"""Constraints in worlds, in what learns from them, and in agents' files."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Agent, Constraint, get_task, load_agent, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.dynamics import FitConfig, TaskWorldModel
from phihp_torchrl.tdmpc import TOLD, TDMPCTrainConfig, TDMPCTrainer
from phihp_torchrl.trainers import ModelConfig, ModelTrainer
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld

PLAIN = get_task("cartpole-swingup")
NEAR = Constraint("x", low=-0.2, high=0.2, price=5.0)
SOFT = replace(PLAIN, constraints=(NEAR,))
HARD = replace(PLAIN, constraints=(replace(NEAR, price=None, hard=True),))
POWER = Constraint(
    "power", high=5.0, hard=True, function=lambda s, action: s[..., 1] * action[..., 0]
)


def push(tensordict):
    return tensordict.set("action", torch.full((*tensordict.batch_size, 1), 10.0))


def test_imagination_alone_pays_for_violations():
    world = SimulatedWorld(SOFT)
    rollout = world.make_env().rollout(40, push)
    state = SOFT.locate(rollout["observation"])
    imagined = TaskWorldModel(SOFT, world.oracle()).transition(state, rollout["action"])
    beyond = (SOFT.locate(rollout["next", "observation"])[:, 0].abs() - 0.2).clamp_min(0.0)
    assert beyond.max() > 0.3
    torch.testing.assert_close(
        rollout["next", "reward"][:, 0] - imagined.reward, 5.0 * beyond, rtol=0, atol=1e-4
    )
    model = world.model().transition(state, rollout["action"])
    torch.testing.assert_close(rollout["next", "reward"][:, 0], model.reward, rtol=0, atol=1e-4)
    assert not rollout["next", "done"].any()


def worlds(task):
    """Environments of one episode each: simulated, a batch of one, and one that knows nothing."""
    world = SimulatedWorld(task)
    blind = replace(task, constraints=())
    return {
        "simulated": world.make_env(),
        "batch": world.make_batch([]),
        "foreign": EnvWorld(task, SimulatedWorld(blind).make_env).make_env(),
    }


@pytest.mark.parametrize("kind", ["simulated", "batch", "foreign"])
@pytest.mark.parametrize("rate", [None, 100.0])
def test_a_hard_constraint_ends_the_episode_in_model_and_world(kind, rate):
    task = replace(HARD, action_rate_limit=rate)
    rollout = worlds(task)[kind].rollout(200, push)
    ended = rollout["next", "terminated"][:, 0]
    assert len(rollout) < 60
    assert ended.nonzero().flatten().tolist() == [len(rollout) - 1]
    assert rollout["next", "done"][-1].item()
    after = task.locate(rollout["next", "observation"])[:, 0]
    assert (after[:-1] <= 0.2).all()
    assert after[-1] > 0.2
    model = SimulatedWorld(task).model()
    state = task.locate(rollout["observation"])
    assert model.transition(state, rollout["action"]).terminated.equal(ended)


@pytest.mark.parametrize("kind", ["simulated", "foreign"])
def test_a_hard_function_ends_by_the_command_that_the_rate_allows(kind):
    """At 100 N/s the force grows by 2 N a step, and power with it."""
    task = replace(PLAIN, constraints=(POWER,), action_rate_limit=100.0)
    rollout = worlds(task)[kind].rollout(200, push)
    forces = torch.arange(2.0, 100.0, 2.0).clamp(max=10.0)[: len(rollout)]
    power = forces * task.locate(rollout["next", "observation"])[:, 1]
    assert (power[:-1] <= 5.0).all()
    assert power[-1] > 5.0
    assert rollout["next", "terminated"][-1].item()


def test_phase_1_hands_on_rewards_less_prices_and_ends():
    task = replace(PLAIN, constraints=(replace(NEAR, low=-0.01, high=0.01), POWER))
    config = ModelConfig(real_steps=60, steps_per_iteration=60, fit=FitConfig(steps=2))
    trainer = ModelTrainer(task, config, seed=0)
    trainer.advance()
    batch = trainer.transitions()
    given = trainer.data["next", "reward"][:, 0]
    paid = 5.0 * (batch.next_state[:, 0].abs() - 0.01).clamp_min(0.0)
    assert paid.max() > 0.01
    torch.testing.assert_close(given - batch.reward, paid)
    assert batch.terminated.equal(batch.next_state[:, 1] * batch.action[:, 0] > 5.0)


def test_td_mpc_learns_with_the_price_and_with_an_end():
    config = TDMPCTrainConfig(real_steps=30, seed_steps=30, batch_size=4)
    near = replace(NEAR, low=-0.01, high=0.01)
    task = replace(PLAIN, constraints=(near,), max_steps=30)
    trainer = TDMPCTrainer(task, config, seed=0)
    given = trainer.advance()["tdmpc/episode_return"]
    free = TDMPCTrainer(task.unpriced(), config, seed=0)
    assert free.advance()["tdmpc/episode_return"] == pytest.approx(given)
    slices, others = trainer.replay.sample(), free.replay.sample()
    assert (slices["next", "reward"] < others["next", "reward"] - 1e-3).any()
    assert TOLD.for_task(HARD).termination is not None
    assert TOLD.for_task(SOFT).termination is None


def test_an_agent_carries_its_constraints(tmp_path):
    task = replace(PLAIN, constraints=(NEAR, Constraint("x_dot", high=3.0, hard=True)))
    save_agent(Agent(task, actor=Actor(task)), tmp_path)
    assert load_agent(tmp_path).task.constraints == task.constraints
    assert load_agent(tmp_path, task=task).task is task
    for other in (SOFT, HARD):
        with pytest.raises(AgentError, match="is another one here: expected its constraints"):
            load_agent(tmp_path, task=other)
    free = tmp_path / "free"
    save_agent(Agent(PLAIN, actor=Actor(PLAIN)), free)
    assert "constraints" not in (free / "agent.json").read_text()
    with pytest.raises(AgentError, match="expected its constraints"):
        load_agent(free, task=SOFT)


def test_a_function_is_no_part_of_a_file(tmp_path):
    task = replace(PLAIN, constraints=(NEAR, POWER))
    save_agent(Agent(task, actor=Actor(task)), tmp_path)
    with pytest.raises(AgentError, match=r"trained with \['power'\].*pass it as task"):
        load_agent(tmp_path)
    assert load_agent(tmp_path, task=task).task is task


@pytest.mark.parametrize("saved", [[{"name": "x"}], [{"nme": "x"}], "x", {"x": 1}, [3]])
def test_a_damaged_file_is_refused(saved, tmp_path):
    save_agent(Agent(SOFT, actor=Actor(SOFT)), tmp_path)
    path = tmp_path / "agent.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "constraints": saved}))
    with pytest.raises(AgentError):
        load_agent(tmp_path)
