"""Gymnasium ids of simulated worlds: the table agrees with the tasks, and users have their own."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit

import phihp_torchrl
from phihp_torchrl import get_task, register_task
from phihp_torchrl.worlds import TaskEnv, make_task_env, register_env

from ..ids import TASKS, all_ids
from ..sled import sled_task


def test_the_table_of_ids_agrees_with_the_tasks():
    table = phihp_torchrl._ENV_IDS
    assert {env_id: name for env_id, (name, _) in table.items()} == TASKS
    for env_id, (name, steps) in table.items():
        assert get_task(name).max_steps == steps
        camel = "".join(part.capitalize() for part in name.split("-"))
        assert env_id == f"phihp/{camel.replace('Cartpole', 'CartPole')}-v0"


@all_ids
def test_an_id_makes_the_world_of_its_task(env_id):
    task = get_task(TASKS[env_id])
    env = gym.make(env_id)
    assert env.unwrapped.task is task
    assert env.spec.max_episode_steps == task.max_steps
    assert env.spec.id == env_id


def test_ids_are_there_without_importing_torch():
    code = (
        "import gymnasium, sys, phihp_torchrl; "
        "print(sorted(i for i in gymnasium.registry if i.startswith('phihp/'))); "
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(sorted([*TASKS, "phihp/Task-v0"]))


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
    register_env("mine/Sled-v3", register_task(sled_task()))
    env = gym.make("mine/Sled-v3", integrator="rk4")
    assert env.spec.max_episode_steps == 5
    assert env.reset(seed=0)[0].shape == (2,)


@pytest.mark.usefixtures("registries")
def test_registration_is_idempotent(recwarn):
    register_env("mine/Pendulum-v0", get_task("pendulum"))
    before = dict(gym.registry)
    register_env("mine/Pendulum-v0", get_task("acrobot"))
    assert gym.registry == before
    assert gym.make("mine/Pendulum-v0").unwrapped.task.name == "pendulum"
    assert not recwarn


def test_the_worlds_of_tasks_without_an_id_are_limited():
    task = replace(get_task("pendulum"), name="short", max_steps=3)
    env = gym.make("phihp/Task-v0", task=task)
    assert isinstance(env, TimeLimit) or any(
        isinstance(layer, TimeLimit) for layer in (env.env, env.env.env)
    )
    env.reset(seed=0)
    assert [env.step(np.zeros(1))[3] for _ in range(3)] == [False, False, True]
    unlimited = make_task_env(task)
    unlimited.reset(seed=0)
    assert not any(unlimited.step(np.zeros(1))[3] for _ in range(5))
