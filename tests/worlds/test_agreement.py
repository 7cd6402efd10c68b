"""Where a world contradicts its task: what is said of it, and with which counts."""

from __future__ import annotations

import gymnasium
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import GymWrapper

from phihp_torchrl import get_task
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.trainers import ModelConfig, ModelTrainer
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld, disagreements


def steps(task, count, *, terminated=None, reward=None):
    """Transitions that stand still, as a world gives them."""
    state = torch.zeros(count, task.state_dim)
    action = torch.zeros(count, task.action_dim)
    observation = task.observe(state)
    if terminated is None:
        terminated = task.is_terminated(state)
    if reward is None:
        reward = task.reward(state, action, state)
    following = TensorDict(
        observation=observation,
        reward=reward.reshape(count, 1),
        terminated=terminated.reshape(count, 1),
        batch_size=[count],
    )
    return TensorDict(observation=observation, action=action, next=following, batch_size=[count])


@pytest.mark.parametrize("name", list_tasks())
def test_a_simulated_world_agrees_with_its_task(name):
    world = SimulatedWorld(name)
    batch, alone = world.make_batch([50], seed=0), world.make_env()
    alone.set_seed(0)
    for env, length in ((batch, 100), (alone, 30)):
        data = env.rollout(length, break_when_any_done=False)
        assert disagreements(world.task, data.reshape(-1)) == []


@given(st.integers(1, 30), st.integers(1, 30))
def test_ends_that_the_task_does_not_know_are_counted(early, others):
    task = get_task("cartpole")
    count = early + others
    terminated = torch.arange(count) < early
    (found,) = disagreements(task, steps(task, count, terminated=terminated))
    assert found.startswith(f"the world ended {early} of {count} steps after which the task says")
    assert "Task(terminated=...)" in found


def test_ends_that_the_world_does_not_know_are_counted():
    task = get_task("cartpole")
    state = torch.tensor([[9.0, 0.0, 0.0, 0.0], [0.0] * 4, [0.0] * 4])
    data = steps(task, 3)
    data["next", "observation"] = task.observe(state)
    (found,) = disagreements(task, data)
    assert found.startswith("the world went on after 1 of 3 steps that the task says are the last")


@pytest.mark.parametrize(("offset", "told"), [(0.0, 0), (0.5, 1), (-0.5, 1), (1e-4, 0)])
def test_a_reward_that_differs_is_told_in_units_of_reward(offset, told):
    task = get_task("pendulum")
    world = SimulatedWorld(task)
    data = world.make_batch([20], seed=0).rollout(20).reshape(-1)
    spread = data["next", "reward"].std().item()
    data["next", "reward"] += offset * spread
    found = disagreements(task, data)
    assert len(found) == told
    if told:
        assert (
            f"differs from the task's by {abs(offset) * spread:.3g} a step on average" in found[0]
        )


def test_constant_rewards_have_no_spread_to_hide_in():
    task = get_task("cartpole")
    assert disagreements(task, steps(task, 5, reward=torch.ones(5))) == []
    assert len(disagreements(task, steps(task, 5, reward=torch.full((5,), 1.01)))) == 1


def test_all_that_is_wrong_is_said():
    task = get_task("cartpole")
    terminated = torch.tensor([True, False, False])
    data = steps(task, 3, terminated=terminated, reward=torch.zeros(3))
    data["next", "observation"][2] = task.observe(torch.tensor([9.0, 0.0, 0.0, 0.0]))
    assert [sentence.split()[1:3] for sentence in disagreements(task, data)] == [
        ["world", "ended"],
        ["world", "went"],
        ["world's", "reward"],
    ]


class Lap(gymnasium.Wrapper):
    """Ends an episode whenever its pendulum is quick, which the task says nothing of."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, bool(abs(observation[2]) > 1.0), truncated, info


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
def test_a_world_with_an_end_of_its_own_is_warned_about_with_counts(caplog):
    task = get_task("pendulum")
    world = EnvWorld(task, lambda: GymWrapper(Lap(gymnasium.make("phihp/Pendulum-v0"))))
    data = world.make_env().rollout(60, break_when_any_done=False)
    ended = int(data["next", "terminated"].sum())
    assert ended > 0
    (found,) = disagreements(task, data)
    assert f"the world ended {ended} of 60 steps" in found

    config = ModelConfig(
        kind="data_driven", real_steps=60, steps_per_iteration=60, hidden_sizes=(4,)
    )
    trainer = ModelTrainer(task, config, seed=0, world=world)
    while not trainer.done:
        trainer.advance()
    warned = [record.message for record in caplog.records if "the world ended" in record.message]
    assert len(warned) == 1
    assert "of 60 steps after which the task says it goes on" in warned[0]
