"""The gymnasium worlds: gymnasium's own check, parity with the tasks, seeds, pictures, errors."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv, PendulumEnv
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from phihp_torchrl import Task, get_task, register_task
from phihp_torchrl.envs import TaskEnv, register_envs
from phihp_torchrl.systems import Pendulum, System
from phihp_torchrl.tasks import Box, list_tasks

TASKS = {
    "phihp/Pendulum-v0": "pendulum",
    "phihp/PendulumSwingup-v0": "pendulum-swingup",
    "phihp/CartPole-v0": "cartpole",
    "phihp/CartPoleSwingup-v0": "cartpole-swingup",
    "phihp/CartPoleSwingupPublished-v0": "cartpole-swingup-published",
    "phihp/Acrobot-v0": "acrobot",
    "phihp/AcrobotSwingup-v0": "acrobot-swingup",
}
all_worlds = pytest.mark.parametrize("env_id", list(TASKS))
one_of_each = pytest.mark.parametrize(
    "env_id", ["phihp/Pendulum-v0", "phihp/CartPoleSwingup-v0", "phihp/AcrobotSwingup-v0"]
)


@pytest.fixture(autouse=True)
def _no_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")


@pytest.fixture
def registries(monkeypatch):
    """Copies of both registries, so that a test leaves nothing behind."""
    tasks = {name: get_task(name) for name in list_tasks()}
    monkeypatch.setattr("phihp_torchrl.tasks.registry._TASKS", tasks)
    monkeypatch.setattr("gymnasium.envs.registration.registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)


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
@all_worlds
def test_gymnasium_accepts_the_world(env_id):
    pytest.importorskip("pygame")
    check_env(gym.make(env_id).unwrapped)


@all_worlds
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


@pytest.mark.parametrize("integrator", [None, "semi_implicit_euler", "rk4", "dopri5"])
@all_worlds
def test_world_and_task_agree_step_by_step(env_id, integrator):
    options = {} if integrator is None else {"integrator": integrator}
    env, task = gym.make(env_id, **options), get_task(TASKS[env_id])
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(12):
        state = torch.from_numpy(env.unwrapped.state)
        action = 2 * env.action_space.sample()  # beyond the bounds half of the time
        observation, reward, terminated, truncated, info = env.step(action)
        held = task.clip_action(torch.from_numpy(action).double())
        next_state = task.step(state, held, integrator)
        np.testing.assert_array_equal(env.unwrapped.state, next_state.numpy())
        assert reward == task.reward(state, held, next_state).item()
        assert terminated == task.is_terminated(next_state).item()
        assert (truncated, info) == (False, {})
        expected = task.system.observe(next_state).float().numpy()
        np.testing.assert_array_equal(observation, expected)
        if terminated:
            env.reset()


@all_worlds
def test_seeds_reproduce_an_episode_and_differ(env_id):
    first, second, other = (rollout(gym.make(env_id), seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first[0], other[0])
    env = gym.make(env_id)
    starts = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert not np.array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[1], starts[2])


@all_worlds
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


@all_worlds
def test_state_is_readable_and_settable(env_id):
    env, task = gym.make(env_id), get_task(TASKS[env_id])
    assert env.unwrapped.state is None
    env.reset(seed=0)
    state = env.unwrapped.state
    assert (state.dtype, state.shape) == (np.float64, (task.system.state_dim,))
    kept = state.copy()
    env.step(env.action_space.sample())
    np.testing.assert_array_equal(state, kept)  # what was read is not stepped under one's feet

    mine = np.array(task.coverage.high) / 3
    env.unwrapped.state = mine.tolist()
    np.testing.assert_array_equal(env.unwrapped.state, mine)
    action = np.zeros(env.action_space.shape, np.float32)
    observation, *_ = env.step(action)
    expected = task.step(torch.from_numpy(mine), torch.from_numpy(action).double())
    np.testing.assert_array_equal(env.unwrapped.state, expected.numpy())
    np.testing.assert_array_equal(observation, task.system.observe(expected).float().numpy())

    observation, _ = env.reset(options={"state": mine})
    np.testing.assert_array_equal(env.unwrapped.state, mine)
    expected = task.system.observe(torch.from_numpy(mine)).float().numpy()
    np.testing.assert_array_equal(observation, expected)
    mine[0] = 99.0  # the world has its own copy
    assert env.unwrapped.state[0] != 99.0


@all_worlds
def test_episodes_are_truncated_at_the_last_step_and_never_ended_by_time(env_id):
    env, task = gym.make(env_id), get_task(TASKS[env_id])
    assert env.spec.max_episode_steps == task.max_steps
    env.reset(seed=0)
    still = np.zeros(task.system.state_dim)
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


@all_worlds
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


# Pictures.


def picture(env, state):
    env.reset(options={"state": state})
    return env.render()


def centre_row(image, colour):
    """Mean row of the pixels of a colour, from the top."""
    rows = np.nonzero((image == colour).all(-1))[0]
    assert rows.size
    return rows.mean()


@one_of_each
def test_pictures_are_gymnasiums_and_follow_the_state(env_id):
    pytest.importorskip("pygame")
    env = gym.make(env_id, render_mode="rgb_array")
    base = {"P": PendulumEnv, "C": CartPoleEnv, "A": AcrobotEnv}[env_id[6]]
    assert isinstance(env.unwrapped, base)
    # The part that moves: its colour, and where it is with the arm down and up.
    n, angle, down, up, colour = {
        "P": (2, 0, math.pi, 0.0, (204, 77, 77)),
        "C": (4, 2, math.pi, 0.0, (202, 152, 101)),
        "A": (4, 0, 0.0, math.pi, (0, 204, 204)),
    }[env_id[6]]
    image = {}
    for position in (down, up):
        state = np.zeros(n)
        state[angle] = position
        image[position] = picture(env, state)
        assert image[position].dtype == np.uint8
        assert image[position].shape[-1] == 3
    assert centre_row(image[up], colour) < centre_row(image[down], colour) - 50
    # Nothing is cut off: both ways the arm covers as many pixels.
    covered = [(image[p] == colour).all(-1).sum() for p in (up, down)]
    assert covered[0] == pytest.approx(covered[1], rel=0.05)
    env.close()


def test_the_pendulums_arrow_shows_the_applied_torque():
    pytest.importorskip("pygame")
    env = gym.make("phihp/Pendulum-v0", render_mode="rgb_array")
    env.reset(options={"state": [0.0, 0.0]})
    assert env.unwrapped.last_u is None
    env.step(np.array([50.0]))
    assert env.unwrapped.last_u == 2.0
    pushed = env.render()
    env.unwrapped.state = [0.0, 0.0]
    env.step(np.array([-0.5]))
    assert env.unwrapped.last_u == -0.5
    assert not np.array_equal(pushed, env.render())
    env.close()


def test_a_cart_that_ran_far_away_can_still_be_drawn():
    pytest.importorskip("pygame")
    env = gym.make("phihp/CartPoleSwingup-v0", render_mode="rgb_array")
    picture(env, [1e6, 0.0, 0.0, 0.0])
    assert env.unwrapped.state[0] == 1e6
    env.close()


# Tasks of the user's own.


class Sled(System):
    """A mass that slides."""

    state_names = ("x", "v")
    action_names = ("force",)
    velocity_of: ClassVar = {"x": "v"}
    default_constants: ClassVar = {"mass": 2.0}

    def prior(self, state, action, constants):
        return torch.stack([state[..., 1], action[..., 0] / constants["mass"]], -1)


def sled_task(**changes):
    return Task(
        **{
            "name": "sled",
            "system": Sled(),
            "action_high": (1.0,),
            "time_step": 0.1,
            "max_steps": 5,
            "reset": Box((-1.0, 0.0), (1.0, 0.0)),
            "reward": lambda state, action, next_state: -next_state[..., 0].abs(),
            "velocity_limits": {"v": 3.0},
            **changes,
        }
    )


@pytest.mark.usefixtures("registries")
@pytest.mark.filterwarnings("ignore:.*Box.*space m:UserWarning")
def test_a_system_of_the_users_own_is_a_world_without_pictures():
    register_task(sled_task())
    env = gym.make("phihp/Task-v0", task="sled")
    check_env(env.unwrapped, skip_render_check=True)
    assert type(env.unwrapped) is TaskEnv
    np.testing.assert_array_equal(env.observation_space.high, np.float32([np.inf, 3.0]))
    env.reset(seed=0)
    truncations = [env.step(np.ones(1, np.float32))[3] for _ in range(5)]
    assert truncations == [False] * 4 + [True]
    assert env.unwrapped.state[1] == pytest.approx(5 * 0.1 / 2.0)


@pytest.mark.usefixtures("registries")
def test_an_id_of_the_users_own():
    register_task(sled_task(env_id="mine/Sled-v3"))
    register_envs()
    env = gym.make("mine/Sled-v3", integrator="rk4")
    assert env.spec.max_episode_steps == 5
    assert env.reset(seed=0)[0].shape == (2,)


def test_a_task_on_a_known_system_is_drawn():
    pytest.importorskip("pygame")
    moon = replace(get_task("pendulum"), name="moon", system=Pendulum({"gravity": 1.6}))
    env = gym.make("phihp/Task-v0", task=moon, render_mode="rgb_array")
    assert picture(env, [0.0, 0.0]).shape == (500, 500, 3)
    assert env.unwrapped.task is moon
    env.close()


def test_registration_is_idempotent(recwarn):
    before = dict(gym.registry)
    register_envs()
    register_envs()
    assert gym.registry == before
    assert not recwarn


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
    with pytest.raises(ValueError, match=r"^action: expected shape \(1,\) and .*±\(10.0,\)"):
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
