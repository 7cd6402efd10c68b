"""A simulated world as a gymnasium environment: gymnasium's check, parity, seeds, errors."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from phihp_torchrl import get_task
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld, TaskEnv, find_plant

from ..ids import TASKS, all_ids
from ..sled import Sled, sled_task


def rollout(env, seed, steps=30):
    """Observations of an episode under seeded random actions."""
    env.action_space.seed(seed)
    observations = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        observations.append(observation)
        if terminated or truncated:
            break
    return np.stack(observations)


@pytest.mark.filterwarnings("ignore:.*Box.*space m:UserWarning")  # cart-poles have no limits
@pytest.mark.filterwarnings("ignore:.*normalized space:UserWarning")  # actions are in N and N·m
@all_ids
def test_gymnasium_accepts_the_world(env_id):
    pytest.importorskip("pygame")
    check_env(gym.make(env_id).unwrapped)


@all_ids
def test_spaces_are_those_of_the_task(env_id):
    env, task = gym.make(env_id), get_task(TASKS[env_id])
    assert env.unwrapped.task is task
    assert env.action_space == gym.spaces.Box(
        -np.float32(task.action_high), np.float32(task.action_high), dtype=np.float32
    )
    inf = math.inf
    high = {
        "Pend": [1, 1, inf],
        "Cart": [inf, inf, 1, 1, inf],
        "Acro": [1, 1, 1, 1, 4 * math.pi, 9 * math.pi],
    }[env_id[6:10]]
    assert env.observation_space.dtype == np.float32
    np.testing.assert_array_equal(env.observation_space.high, np.float32(high))
    np.testing.assert_array_equal(env.observation_space.low, -np.float32(high))


@pytest.mark.filterwarnings("ignore:.*Box.*space m:UserWarning")
@pytest.mark.filterwarnings("ignore:.*normalized space:UserWarning")
@pytest.mark.parametrize(("low", "high"), [((-6.0,), (12.0,)), ((0.0,), (100.0,))])
def test_spaces_and_steps_of_asymmetric_bounds(low, high):
    env = TaskEnv(replace(get_task("pendulum"), action_low=low, action_high=high))
    assert env.action_space == gym.spaces.Box(np.float32(low), np.float32(high), dtype=np.float32)
    env.action_space.seed(0)
    actions = np.stack([env.action_space.sample() for _ in range(500)])
    assert ((actions >= low) & (actions <= high)).all()
    assert (np.ptp(actions) > 0.95 * np.subtract(high, low)).all()
    for action, held in ((-1e3, low[0]), (1e3, high[0]), (high[0] / 2, high[0] / 2)):
        ends = []
        for torque in (action, held):
            env.reset(options={"state": [1.0, 0.0]})
            env.step(np.array([torque], dtype=np.float32))
            ends.append(env.state)
        np.testing.assert_array_equal(*ends)
        assert env.last_action == held
    check_env(env, skip_render_check=True)


def test_the_space_of_asymmetric_velocity_limits():
    env = TaskEnv(sled_task(velocity_limits={"v": (-0.5, 2.0)}))
    np.testing.assert_array_equal(env.observation_space.low, np.float32([-np.inf, -0.5]))
    np.testing.assert_array_equal(env.observation_space.high, np.float32([np.inf, 2.0]))
    env.reset(options={"state": [0.0, 0.0]})
    for _ in range(50):
        observation, *_ = env.step(np.array([-1.0]))
    assert observation[1] == -0.5


def test_the_plant_is_the_truth():
    task = get_task("pendulum")
    heavy = find_plant(task.system, {"mass": 2.0}, {"joint": 0.0})
    config = SimulatedConfig(constants={"mass": 2.0}, friction={"joint": 0.0})
    env = TaskEnv(task, plant=heavy)
    env.reset(options={"state": [1.0, -2.0]})
    env.step(np.array([1.0]))
    state, action = torch.tensor([[1.0, -2.0], [1.0, 0.0]]).double()
    expected = SimulatedWorld(task, config).step(state, action[:1])
    np.testing.assert_array_equal(env.state, expected.numpy())
    assert not torch.equal(expected, SimulatedWorld(task).step(state, action[:1]))
    assert env.plant is heavy


@pytest.mark.parametrize("integrator", [None, "semi_implicit_euler", "rk4", "dopri5"])
@all_ids
def test_world_and_task_agree_step_by_step(env_id, integrator):
    options = {} if integrator is None else {"integrator": integrator}
    env, task = gym.make(env_id, **options), get_task(TASKS[env_id])
    move = SimulatedWorld(task, SimulatedConfig(**options)).step
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(12):
        state = torch.from_numpy(env.unwrapped.state)
        action = 2 * env.action_space.sample()  # beyond the bounds half of the time
        observation, reward, terminated, truncated, info = env.step(action)
        held = task.clip_action(torch.from_numpy(action).double())
        next_state = move(state, held)
        np.testing.assert_array_equal(env.unwrapped.state, next_state.numpy())
        assert reward == task.reward(state, held, next_state).item()
        assert terminated == task.is_terminated(next_state).item()
        assert (truncated, info) == (False, {})
        expected = task.observe(next_state).float().numpy()
        np.testing.assert_array_equal(observation, expected)
        if terminated:
            env.reset()


@all_ids
def test_seeds_reproduce_an_episode_and_differ(env_id):
    first, second, other = (rollout(gym.make(env_id), seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first[0], other[0])
    env = gym.make(env_id)
    starts = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert not np.array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[1], starts[2])


@all_ids
def test_resets_fill_the_tasks_box(env_id):
    env, box = gym.make(env_id), get_task(TASKS[env_id]).reset
    env.reset(seed=0)
    starts = []
    for _ in range(300):
        env.reset()
        starts.append(env.unwrapped.state)
    starts = np.stack(starts)
    low, high = np.array(box.low), np.array(box.high)
    assert ((starts >= low) & (starts <= high)).all()
    assert (np.ptp(starts, axis=0) > 0.95 * (high - low)).all()


@all_ids
def test_state_is_readable_and_settable(env_id):
    env, task = gym.make(env_id), get_task(TASKS[env_id])
    assert env.unwrapped.state is None
    env.reset(seed=0)
    state = env.unwrapped.state
    assert (state.dtype, state.shape) == (np.float64, (task.state_dim,))
    kept = state.copy()
    env.step(env.action_space.sample())
    np.testing.assert_array_equal(state, kept)  # what was read is not stepped under one's feet

    mine = np.array(task.coverage.high) / 3
    env.unwrapped.state = mine.tolist()
    np.testing.assert_array_equal(env.unwrapped.state, mine)
    action = np.zeros(env.action_space.shape, np.float32)
    observation, *_ = env.step(action)
    step = SimulatedWorld(task).step
    expected = step(torch.from_numpy(mine), torch.from_numpy(action).double())
    np.testing.assert_array_equal(env.unwrapped.state, expected.numpy())
    np.testing.assert_array_equal(observation, task.observe(expected).float().numpy())

    observation, _ = env.reset(options={"state": mine})
    np.testing.assert_array_equal(env.unwrapped.state, mine)
    expected = task.observe(torch.from_numpy(mine)).float().numpy()
    np.testing.assert_array_equal(observation, expected)
    mine[0] = 99.0  # the world has its own copy
    assert env.unwrapped.state[0] != 99.0


@all_ids
def test_episodes_are_truncated_at_the_last_step_and_never_ended_by_time(env_id):
    env, task = gym.make(env_id), get_task(TASKS[env_id])
    assert env.spec.max_episode_steps == task.max_steps
    env.reset(seed=0)
    still = np.zeros(task.state_dim)
    for step in range(1, task.max_steps + 1):
        env.unwrapped.state = still  # an equilibrium where no task ends
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
        assert not terminated
        assert truncated == (step == task.max_steps)


def test_termination_is_not_truncation():
    env = gym.make("phihp/CartPole-v0")
    env.reset(options={"state": [2.399, 5.0, 0.0, 0.0]})
    for _ in range(2):  # a step past the end still earns what the task says
        _, reward, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        assert (reward, terminated, truncated) == (1.0, True, False)
    env.reset(seed=0)
    assert not env.step(np.zeros(1, np.float32))[2]


def test_integrators_differ():
    ends = {}
    for integrator in ("semi_implicit_euler", "rk4", "dopri5"):
        env = gym.make("phihp/AcrobotSwingup-v0", integrator=integrator)
        env.reset(options={"state": [1.0, 0.5, 0.0, 0.0]})
        env.step(np.ones(2, np.float32))
        ends[integrator] = env.unwrapped.state
    assert np.abs(ends["rk4"] - ends["dopri5"]).max() < 1e-3
    assert np.abs(ends["rk4"] - ends["semi_implicit_euler"]).max() > 1e-2


@all_ids
def test_vectorised_worlds_reset_themselves(env_id):
    envs = gym.make_vec(env_id, num_envs=2, vectorization_mode="sync")
    observations, _ = envs.reset(seed=0)
    assert not np.array_equal(*observations)
    observations, rewards, *_ = envs.step(envs.action_space.sample())
    assert observations in envs.observation_space
    assert rewards.shape == (2,)


def test_worlds_can_be_copied_and_their_specs_written():
    env = gym.make("phihp/CartPole-v0", integrator="rk4")
    assert json.loads(env.spec.to_json())["kwargs"] == {"task": "cartpole", "integrator": "rk4"}
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    action = np.ones(1, np.float32)
    np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])


# Bad input.


@pytest.mark.parametrize(
    "action",
    [
        1.0,
        [],
        [0.0, 0.0],
        [[0.0]],
        [math.nan],
        [math.inf],
        ["left"],
        [1j],
        [None],
    ],
)
def test_bad_actions_name_shape_and_bounds(action):
    env = gym.make("phihp/CartPole-v0")
    env.reset(seed=0)
    before = env.unwrapped.state.copy()
    message = r"^action: expected shape \(1,\) and finite values, bounds \(-10\.0,\) to \(10\.0,\);"
    with pytest.raises(ValueError, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.unwrapped.state, before)


@pytest.mark.parametrize("state", [0.0, [0.0] * 3, [[0.0] * 4], [0, 0, math.nan, 0], ["a"] * 4])
def test_bad_states_name_shape_and_components(state):
    env = gym.make("phihp/CartPole-v0")
    env.reset(seed=0)
    message = r"^state: expected shape \(4,\) and .*'x', 'x_dot', 'theta', 'theta_dot'"
    with pytest.raises(ValueError, match=message):
        env.unwrapped.state = state
    with pytest.raises(ValueError, match=message):
        env.reset(options={"state": state})


def test_a_world_that_blows_up_says_so():
    env = TaskEnv(sled_task(system=Sled({"mass": 1e-320}), velocity_limits={}))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^state: expected shape \(2,\) and finite values"):
        env.step(np.ones(1))


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match=r"^integrator: expected one of .*got 'leapfrog'"):
        gym.make("phihp/Acrobot-v0", integrator="leapfrog")
    with pytest.raises(ValueError, match=r"^task: expected one of .*got 'unicycle'"):
        gym.make("phihp/Task-v0", task="unicycle")
    with pytest.raises(ValueError, match=r"^render_mode: expected one of .*got 'ascii'"):
        TaskEnv("pendulum", render_mode="ascii")
    env = gym.make("phihp/Pendulum-v0")
    with pytest.raises(ValueError, match=r"^options: unknown \['x_init'\]"):
        env.reset(options={"x_init": 0.0})
    with pytest.raises(TypeError, match="gravity"):
        gym.make("phihp/Pendulum-v0", gravity=3.0)


def test_step_needs_a_reset():
    with pytest.raises(ResetNeeded):
        TaskEnv("pendulum").step(np.zeros(1))
