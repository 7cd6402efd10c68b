"""What a policy earns, in the simulated world and in every other."""

from __future__ import annotations

import gc
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv

from phihp_torchrl import evaluate, get_task
from phihp_torchrl.agents import Actor, make_actor
from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation import measure_latency, play_episode, returns
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.worlds import (
    EnvWorld,
    GuardedWorld,
    GymnasiumConfig,
    GymnasiumWorld,
    SimulatedConfig,
    SimulatedWorld,
)

from .policies import Noisy, balance, constant, planner


def test_returns_by_hand():
    # Without a push the pole falls; every step counts 1, the last included.
    result = evaluate(constant(), "cartpole", episodes=20)
    assert torch.equal(result.returns, result.lengths.to(torch.float64))
    assert result.terminated.all()
    assert 5 < result.mean < 200
    result = evaluate(balance(), "cartpole", episodes=8)
    assert result.returns.tolist() == [500.0] * 8
    assert not result.terminated.any(), "running out of steps is not termination"
    assert (result.mean, result.std, result.standard_error) == (500.0, 0.0, 0.0)
    # One step of a pendulum, by its reward.
    task = replace(get_task("pendulum"), max_steps=1)
    state = task.reset.sample([6], generator=torch.Generator().manual_seed(3))
    expected = -(state[:, 0].square() + 0.1 * state[:, 1].square() + 0.001 * 1.5**2)
    result = evaluate(constant(1.5), task, episodes=6, seed=3)
    torch.testing.assert_close(result.returns, expected.to(torch.float64))


@pytest.mark.parametrize("name", list_tasks())
def test_the_fast_way_is_the_environments_way(name):
    task = replace(get_task(name), max_steps=60)
    policy = Actor(task, (8,))
    policy = TensorDictModule(policy, ["observation"], ["action"])
    fast = evaluate(policy, task, episodes=6, seed=5)
    slow = evaluate(policy, task, episodes=6, seed=5, env=SimulatedWorld(task).make_batch([6]))
    torch.testing.assert_close(fast.returns, slow.returns, rtol=1e-4, atol=1e-4)
    assert torch.equal(fast.lengths, slow.lengths)
    assert torch.equal(fast.terminated, slow.terminated)


@pytest.mark.parametrize("batch", [None, 2])
def test_chatter_is_of_the_second_half_in_half_ranges(batch):
    """Full swings in the first half do not count, and 2, 0, 2, 0 N of 10 N do; +99 N is 10 N."""
    task = replace(get_task("cartpole-swingup"), max_steps=8)
    plays = iter([99.0, -99.0, 99.0, -10.0, 2.0, 0.0, 2.0, 0.0] * 2)

    def act(observation):
        return torch.full_like(observation[..., :1], next(plays))

    policy = TensorDictModule(act, ["observation"], ["action"])
    env = None if batch is None else SimulatedWorld(task).make_batch([batch])
    result = evaluate(policy, task, episodes=2, env=env)
    half_range = task.bounds.scale.item()
    expected = (12.0 + 2.0 + 2.0 + 2.0) / 4 / half_range
    assert half_range == 10.0
    assert result.chatter.tolist() == pytest.approx([expected] * 2)
    assert result.summary()["chatter"] == pytest.approx(expected)
    one_step = evaluate(constant(), replace(task, max_steps=1), episodes=2)
    assert one_step.chatter.tolist() == [0.0, 0.0]


def test_rewards_after_the_end_do_not_count():
    task = replace(
        get_task("cartpole"),
        terminated=lambda state: state[..., 2].abs() > 0.01,
        reward=lambda state, action, next_state: state[..., 2].abs() * 1e3,
    )
    for env in (None, SimulatedWorld(task).make_batch([20])):
        result = evaluate(constant(), task, episodes=20, env=env)
        assert result.terminated.all()
        assert (result.returns <= 1e3 * (0.01 * (result.lengths - 1) + 0.05)).all()


def test_seeds_reproduce_and_pair():
    agent = planner(warm_start=True)
    task = replace(agent.task, max_steps=15)
    first = evaluate(agent, task, episodes=4, seed=1)
    assert torch.equal(first.returns, evaluate(agent, task, episodes=4, seed=1).returns)
    assert not torch.equal(first.returns, evaluate(agent, task, episodes=4, seed=2).returns)
    # Without randomness in the policy the same starts mean the same returns, alone or in a batch.
    start = replace(task, max_steps=1)
    still = evaluate(constant(), start, episodes=4, seed=1).returns
    assert torch.equal(still, evaluate(constant(), start, episodes=7, seed=1).returns[:4])


def test_a_policy_without_noise_does_not_see_the_batch():
    task = replace(get_task("cartpole-swingup"), max_steps=40)
    policy = TensorDictModule(Actor(task, (8,)), ["observation"], ["action"])
    whole = evaluate(policy, task, episodes=6, seed=1)
    part = evaluate(policy, task, episodes=3, seed=1)
    torch.testing.assert_close(whole.returns[:3], part.returns)


def test_the_global_random_state_is_left_alone():
    task = replace(get_task("pendulum"), max_steps=3)
    before = torch.get_rng_state()
    evaluate(Noisy(), task, episodes=2)
    evaluate(Noisy(), task, episodes=2, env=SimulatedWorld(task).make_batch([2], seed=0))
    measure_latency(Noisy(), task, calls=2, warmup=0)
    play_episode(Noisy(), task)
    assert torch.equal(before, torch.get_rng_state())


# Other worlds.


def test_a_world_of_other_constants_is_another_world():
    task = replace(get_task("pendulum"), max_steps=60)
    policy = make_actor(task, (8,))
    here = evaluate(policy, task, episodes=6, seed=5)
    same = evaluate(policy, task, episodes=6, seed=5, world=SimulatedWorld(task))
    assert torch.equal(here.returns, same.returns)
    config = SimulatedConfig(constants={"mass": 1.5}, friction={"joint": 0.5})
    heavy = SimulatedWorld(task, config)
    there = evaluate(policy, task, episodes=6, seed=5, world=heavy)
    assert (there.returns - here.returns).abs().min() > 1e-3
    slow = evaluate(policy, task, episodes=6, seed=5, env=heavy.make_batch([6]))
    torch.testing.assert_close(there.returns, slow.returns, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("copies", [True, False])
def test_a_world_that_is_not_simulated_plays_episodes_from_its_seed(copies):
    task = replace(get_task("pendulum"), max_steps=25)
    world = GymnasiumWorld(task, GymnasiumConfig("Pendulum-v1", copies=copies))
    result = evaluate(constant(1.5), task, episodes=3, seed=4, world=world)
    assert result.lengths.tolist() == [25] * 3
    assert not result.terminated.any()
    again = evaluate(constant(1.5), task, episodes=3, seed=4, world=world)
    assert torch.equal(result.returns, again.returns)
    assert len(set(result.returns.tolist())) == 3, "each starts elsewhere"
    other = evaluate(constant(1.5), task, episodes=3, seed=5, world=world)
    assert not torch.equal(result.returns, other.returns)
    # An episode played to be looked at is the first of them.
    episode = play_episode(constant(1.5), task, seed=4, world=world)
    assert episode.total_reward == pytest.approx(result.returns[0].item(), rel=1e-5)


@pytest.mark.parametrize("copies", [True, False])
def test_episodes_are_played_at_once_where_each_environment_is_a_world(copies):
    task = replace(get_task("cartpole"), max_steps=120)
    world = EnvWorld(task, SimulatedWorld(task).make_env, copies=copies)
    policy = Noisy()
    result = evaluate(policy, task, episodes=4, seed=0, world=world)
    assert policy.starts[0].shape == ((4, 1) if copies else (1,))
    assert result.lengths.shape == (4,)
    assert torch.equal(result.returns, result.lengths.to(torch.float64))
    assert len(set(result.lengths.tolist())) > 1, "each starts elsewhere"


def test_later_rounds_start_where_they_do_whoever_plays(monkeypatch):
    monkeypatch.setattr(returns, "AT_ONCE", 3)
    task = replace(get_task("cartpole"), max_steps=60)
    world = EnvWorld(task, SimulatedWorld(task).make_env, copies=True)
    firsts = []
    for push in (1.0, 10.0):  # one of them ends sooner, and its worlds begin again
        seen: list[torch.Tensor] = []

        def act(data, push=push, seen=seen):
            if data["is_init"].all():
                seen.append(data["observation"].clone())
            return data.set("action", torch.full((len(data), 1), push))

        assert evaluate(act, task, episodes=6, seed=0, world=world).lengths.shape == (6,)
        firsts.append(torch.cat(seen))
    assert firsts[0].shape == (6, 5)
    torch.testing.assert_close(firsts[0], firsts[1])


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_are_left_alone(threads):
    before = torch.get_num_threads()
    task = replace(get_task("pendulum"), max_steps=3)
    try:
        torch.set_num_threads(threads)
        world = EnvWorld(task, SimulatedWorld(task).make_env, copies=True)
        evaluate(constant(1.0), task, episodes=3, world=world)
        gc.collect()
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_guarded_worlds_are_played_one_after_the_other():
    """A world that begins again, while others go on, would add crossings that no episode had."""
    task = get_task("cartpole")
    world = EnvWorld(task, SimulatedWorld(task).make_env, copies=True)
    assert not GuardedWorld(world, {"x": 2.0}).copies


def test_one_environment_has_no_copies():
    task = get_task("pendulum")
    world = EnvWorld(task, SimulatedWorld(task).make_env(), copies=True)
    assert not world.copies


def test_an_environment_may_be_a_world():
    task = replace(get_task("cartpole"), max_steps=120)
    world = EnvWorld(task, SimulatedWorld(task).make_env)
    policy = Noisy()
    result = evaluate(policy, task, episodes=4, seed=0, world=world)
    assert sum(int(start) for start in policy.starts) == 4
    assert torch.equal(result.returns, result.lengths.to(torch.float64))
    assert (result.lengths < 120).any()
    assert torch.equal(result.terminated, result.lengths < 120)


@pytest.mark.parametrize("batch", [[], [2], [5]])
def test_other_environments_play_rounds(batch):
    task = replace(get_task("cartpole"), max_steps=30)
    policy = Noisy()
    result = evaluate(policy, task, episodes=5, seed=0, env=SimulatedWorld(task).make_batch(batch))
    assert result.returns.shape == result.lengths.shape == (5,)
    assert policy.starts[0].all()
    assert not policy.starts[1].any()
    if batch == []:
        assert sum(int(start) for start in policy.starts) == 5
    assert torch.equal(result.returns, result.lengths.to(torch.float64))


def test_gymnasium_worlds_play_too():
    env = GymEnv("phihp/CartPole-v0")
    result = evaluate(constant(), "cartpole", episodes=2, env=env)
    assert result.terminated.all()
    assert torch.equal(result.returns, result.lengths.to(torch.float64))


# What is told, and what is refused.


def test_summary_is_numbers():
    summary = evaluate(constant(), "cartpole", episodes=3).summary()
    assert all(isinstance(value, float) and math.isfinite(value) for value in summary.values())
    assert summary["return_min"] <= summary["return_mean"] <= summary["return_max"]
    assert evaluate(constant(), "cartpole", episodes=1).std == 0.0


SIZES = st.lists(st.sampled_from([1, 2, 3]), max_size=3)


@settings(max_examples=30, deadline=None)
@given(shape=SIZES, in_env=st.booleans())
def test_an_action_of_another_shape_is_refused_by_name(shape, in_env):
    """It would break within the world, or be spread over all episodes."""
    task = replace(get_task("pendulum"), max_steps=2)
    policy = Noisy()
    action = torch.zeros(shape)
    right = shape == [3, 1]
    policy.forward = lambda td: td.set("action", action) if right else TensorDict(action=action)
    env = SimulatedWorld(task).make_batch([3]) if in_env else None
    if right:
        assert evaluate(policy, task, episodes=3, env=env).returns.isfinite().all()
    else:
        message = f"policy: expected it to write 'action' of shape [3, 1], got shape {shape}."
        with pytest.raises(ConfigError, match=f"^{re.escape(message)}$"):
            evaluate(policy, task, episodes=3, env=env)


def test_a_policy_that_writes_no_action_is_named():
    elsewhere = TensorDictModule(lambda seen: seen[..., :1], ["observation"], ["torque"])
    for world in (None, EnvWorld(get_task("pendulum"), SimulatedWorld("pendulum").make_env)):
        with pytest.raises(ConfigError, match=r"^policy: expected it to write .* got none"):
            evaluate(elsewhere, "pendulum", episodes=1, world=world)


def test_numbers_of_numpy_are_numbers():
    found, expected = (
        evaluate(constant(), "cartpole", episodes=kind(2), seed=kind(5)) for kind in (np.int64, int)
    )
    assert torch.equal(found.returns, expected.returns)
    for seed in (-1, 1.5, True, "1"):
        with pytest.raises(ConfigError, match=r"^seed: expected a whole number from 0 on, got"):
            evaluate(constant(), "cartpole", episodes=1, seed=seed)


def test_bad_arguments_are_named():
    for episodes in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="episodes: expected a positive whole number"):
            evaluate(constant(), "cartpole", episodes=episodes)
    with pytest.raises(ValueError, match="task: expected one of"):
        evaluate(constant(), "no-such-task")
    with pytest.raises(ValueError, match="env: expected batch size"):
        evaluate(constant(), "cartpole", env=SimulatedWorld("cartpole").make_batch([2, 2]))
    with pytest.raises(ValueError, match="calls: expected"):
        measure_latency(constant(), "cartpole", calls=0)
    with pytest.raises(ValueError, match="warmup: expected"):
        measure_latency(constant(), "cartpole", warmup=-1)
    with pytest.raises(ValueError, match="max_steps: expected"):
        play_episode(constant(), "cartpole", max_steps=0)
    with pytest.raises(ValueError, match="frames_per_second: expected"):
        play_episode(constant(), "cartpole", frames_per_second=0)
