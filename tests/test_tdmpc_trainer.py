"""TD-MPC's trainer and its agents: what is counted, what is acted, what is kept."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type

from phihp_torchrl import get_task, load_agent
from phihp_torchrl.agents.tdmpc import TOLD, TDMPCConfig, TOLDConfig
from phihp_torchrl.deployment import AgentError, TDMPCAgent, save_agent
from phihp_torchrl.planners import MPPIPlanner, MPPISettings
from phihp_torchrl.planners.factory import MPPIConfig
from phihp_torchrl.trainers import TDMPCTrainConfig, TDMPCTrainer

torch.set_num_threads(1)
SMALL = TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8)
PLAN = MPPISettings(
    planning_horizon=2, optim_steps=2, num_candidates=16, top_k=4, num_policy_candidates=3
)


def make_trainer(task="pendulum", max_steps=20, **kwargs):
    config = TDMPCTrainConfig(
        **{
            "real_steps": 70,
            "seed_steps": 30,
            "batch_size": 4,
            "replay_capacity": 500,
            "evaluation_interval": 1000,
            "learn": TDMPCConfig(told=SMALL),
            "planner": MPPIConfig(
                optim_steps=1,
                num_candidates=8,
                top_k=2,
                num_policy_candidates=2,
                schedule_steps=60,
            ),
            **kwargs,
        }
    )
    return TDMPCTrainer(replace(get_task(task), max_steps=max_steps), config, seed=0)


def finish(trainer):
    metrics = []
    while not trainer.done:
        metrics.append(trainer.advance())
    return metrics


# Training.


def test_steps_and_updates_are_counted_as_published():
    """Two random episodes, then as many updates as they had steps; then an episode, its updates."""
    trainer = make_trainer()
    metrics = finish(trainer)
    lengths = [m["tdmpc/episode_length"] for m in metrics if "tdmpc/episode_length" in m]
    updates = [m["tdmpc/updates"] for m in metrics if "tdmpc/updates" in m]
    assert lengths == [20, 20, 20, 10]  # the last is cut off where the steps are used up
    assert updates == [40, 60, 70]
    assert trainer.real_steps == 70
    assert trainer.progress == (70, 70)
    horizons = [m["tdmpc/planning_horizon"] for m in metrics if "tdmpc/episode_length" in m]
    assert horizons == [0, 0, 3, 5]  # 40 and 60 of the schedule's 60 steps


def test_updates_per_step_keeps_fractions():
    trainer = make_trainer(updates_per_step=0.15)
    metrics = finish(trainer)
    updates = [m["tdmpc/updates"] for m in metrics if "tdmpc/updates" in m]
    assert updates == [6, 9, 10]  # of 6, 3 and 1.5


def test_episodes_end_where_the_task_ends_them():
    trainer = make_trainer("cartpole", max_steps=500, real_steps=150, seed_steps=100)
    finish(trainer)
    rows = trainer.replay.buffer.storage[:]
    ends = rows["next", "terminated"][:, 0]
    assert ends.sum() >= 4
    # What follows a termination is padding, one row less than a slice.
    for i in ends.nonzero()[:, 0].tolist():
        assert rows["valid"][i]
        assert not rows["valid"][i + 1 : i + 5].any()
    assert rows["valid"].sum() == 150


def test_evaluation_has_no_part_in_the_training():
    plain, evaluated = make_trainer(), make_trainer(evaluation_interval=20, evaluation_episodes=2)
    torch.manual_seed(1)
    evaluated.told.load_state_dict(plain.told.state_dict())
    evaluated.update.loss.target.load_state_dict(plain.update.loss.target.state_dict())
    finish(plain)
    metrics = finish(evaluated)
    assert sum("return_mean" in m for m in metrics) == 3
    for ours, theirs in zip(plain.told.parameters(), evaluated.told.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_training_explores_and_the_agent_does_not(monkeypatch):
    trainer = make_trainer(evaluation_interval=20, evaluation_episodes=1)
    kinds = {}
    plan_once = MPPIPlanner.planning

    def spy(planner, *args):
        kinds.setdefault(planner is trainer.planner, set()).add(exploration_type())
        return plan_once(planner, *args)

    monkeypatch.setattr(MPPIPlanner, "planning", spy)
    finish(trainer)
    assert kinds[True] == {ExplorationType.RANDOM}
    assert ExplorationType.RANDOM not in kinds[False]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("real_steps", 0),
        ("seed_steps", -1),
        ("updates_per_step", 0.0),
        ("batch_size", 0),
        ("replay_capacity", 5),
        ("priority_alpha", -0.1),
        ("evaluation_interval", 0),
    ],
)
def test_values_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        TDMPCTrainConfig(**{name: value})


# Agents.


def make_agent(task="cartpole", seed=0):
    torch.manual_seed(seed)
    task = get_task(task)
    return TDMPCAgent(task, TOLD.for_task(task, SMALL), PLAN, metadata={"seed": seed})


def situation(agent, *batch):
    generator = torch.Generator().manual_seed(0)
    state = agent.task.reset.sample([*batch], generator=generator)
    return TensorDict(observation=agent.task.system.observe(state), batch_size=batch)


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
    kept = agent.planner.memory.recall(None, torch.zeros(2, 2, 1))
    assert kept.any()
    cold = agent.planner.memory.recall(torch.tensor([True, False]), torch.zeros(2, 2, 1))
    assert torch.equal(cold, torch.stack([torch.zeros(2, 1), kept[1]]))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("mlp_dim", 10**9, "told: expected at most"),
        ("mlp_dim", 16, "expected torch.float32 of shape"),
        ("mlp_dim", 0, "mlp_dim: expected a positive number"),
        ("latent_dim", "4", "told"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path, key, value, message):
    save_agent(make_agent(), tmp_path)
    path = tmp_path / "agent.json"
    content = json.loads(path.read_text())
    content["told"][key] = value
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
