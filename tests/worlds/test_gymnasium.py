"""Worlds behind a gymnasium id: the environment of the task, or an error that says what is not."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.worlds import GymnasiumConfig, GymnasiumWorld, SimulatedConfig, SimulatedWorld

from .ids import TASKS, all_ids

PENDULUM = get_task("pendulum")


def world(id="Pendulum-v1", task=PENDULUM, **options):
    return GymnasiumWorld(task, GymnasiumConfig(id, options))


def test_its_environment_is_the_tasks_and_counts_its_steps():
    env = world().make_env()
    check_env_specs(env, seed=0)
    env.set_seed(0)
    data = env.rollout(500)
    assert data.shape == (200,)
    assert data["next", "step_count"].flatten().tolist() == list(range(1, 201))
    assert data["next", "truncated"][-1].item()
    assert not data["next", "terminated"].any()
    assert {data[key].dtype for key in ("observation", "action")} == {torch.float32}
    assert data["next", "reward"].dtype == torch.float32


def test_it_is_gymnasiums():
    env = world(g=9.81).make_env()
    assert env.base_env._env.unwrapped.g == 9.81
    env.set_seed(0)
    data = env.rollout(5)
    theirs = gymnasium.make("Pendulum-v1", g=9.81)
    theirs.reset(seed=0)
    first = PENDULUM.locate(data["observation"][0])
    theirs.unwrapped.state = first.numpy()
    for step in data:
        observation, reward, *_ = theirs.step(step["action"].numpy())
        close = {"rtol": 1e-4, "atol": 1e-4}
        np.testing.assert_allclose(step["next", "observation"].numpy(), observation, **close)
        assert step["next", "reward"].item() == pytest.approx(float(reward), rel=1e-4, abs=1e-4)


def test_every_call_makes_a_new_environment():
    ours = world()
    one, other = ours.make_env(), ours.make_env()
    assert one.base_env._env.unwrapped is not other.base_env._env.unwrapped


def test_the_shorter_limit_of_steps_counts():
    short = replace(PENDULUM, max_steps=7)
    assert world(task=short).make_env().rollout(500).shape == (7,)
    long = replace(PENDULUM, max_steps=1000)
    data = world(task=long).make_env().rollout(500)
    assert data.shape == (200,)
    assert data["next", "truncated"][-1].item()


@pytest.mark.filterwarnings("ignore:.*render method without:UserWarning")
def test_it_has_no_truth_but_a_name_and_a_picture():
    pytest.importorskip("pygame")
    ours = world()
    assert (ours.truth, ours.model()) == (None, None)
    assert (ours.kind, str(ours)) == ("gymnasium", "gymnasium Pendulum-v1")
    env = ours.make_env(render=True)
    env.reset()
    first = ours.picture(env)
    assert (first.dtype, first.ndim, first.shape[-1]) == (np.uint8, 3, 3)
    env.rollout(20)
    assert not np.array_equal(first, ours.picture(env))
    undrawn = ours.make_env()
    undrawn.reset()
    assert ours.picture(undrawn) is None


@all_ids
def test_our_own_ids_are_worlds_too(env_id):
    task = get_task(TASKS[env_id])
    env = world(env_id, task, integrator="rk4").make_env()
    env.set_seed(0)
    data = env.rollout(10)
    step = SimulatedWorld(task, SimulatedConfig(integrator="rk4")).step
    expected = task.transition(step, task.locate(data["observation"]), data["action"])
    found = task.locate(data["next", "observation"])
    gap = task.difference(found, expected.next_state)
    torch.testing.assert_close(gap, torch.zeros_like(gap), rtol=0, atol=1e-4)
    close = {"rtol": 1e-4, "atol": 1e-4}
    torch.testing.assert_close(data["next", "reward"].squeeze(-1), expected.reward, **close)
    assert torch.equal(data["next", "terminated"].squeeze(-1), expected.terminated)


def test_the_task_that_a_world_speaks_of():
    assert GymnasiumConfig.task_of({"id": "Pendulum-v1"}) == "pendulum"
    assert GymnasiumConfig.task_of({"id": "Ant-v5"}) is None
    assert GymnasiumConfig.task_of({}) is None


@pytest.mark.parametrize(
    ("id", "parts"),
    [
        ("NoSuchWorld-v0", ["'NoSuchWorld-v0'", "doesn't exist"]),
        ("Pendulum-v99", ["'Pendulum-v99'", "`v1`"]),
        ("no id at all", ["'no id at all'"]),
        ("no_such_module:Pendulum-v1", ["'no_such_module:Pendulum-v1'", "no_such_module"]),
        ("MountainCar-v0", ["expected continuous actions, 'MountainCar-v0' has Discrete(3)."]),
    ],
)
def test_an_id_that_is_no_world_is_named(id, parts):
    with pytest.raises(ConfigError) as caught:
        world(id).make_env()
    assert caught.value.key == "world.id"
    for part in parts:
        assert part in caught.value.reason


def test_options_that_it_does_not_have_are_named():
    with pytest.raises(ConfigError, match=r"^world\.id: 'Pendulum-v1': .*gravitas"):
        world(gravitas=9.81).make_env()


def test_a_world_of_another_system_is_refused():
    with pytest.raises(ConfigError) as caught:
        world("MountainCarContinuous-v0").make_env()
    assert caught.value.key == "world"
    assert caught.value.reason == (
        "expected 'observation' of shape [3] (cos theta, sin theta, theta_dot), "
        "got torch.float32 of shape [2]."
    )


def test_a_task_that_wants_more_than_the_world_gives_is_refused():
    strong = replace(PENDULUM, name="strong", action_high=(3.0,), action_low=(-1.0,))
    with pytest.raises(ConfigError) as caught:
        world(task=strong).make_env()
    assert caught.value.key == "action_high"
    assert caught.value.reason == (
        "expected bounds of torque within the world's, -2 to 2; the task 'strong' has -1 to 3."
    )
    gentle = replace(PENDULUM, name="gentle", action_high=(1.0,), action_low=(0.0,))
    assert world(task=gentle).make_env().rollout(2).shape == (2,)


@pytest.mark.parametrize(
    ("id", "options", "copies", "expected"),
    [
        ("Pendulum-v1", {}, None, True),
        ("phihp/Pendulum-v0", {}, None, True),
        ("Pendulum-v1", {"render_mode": "human"}, None, False),
        ("Pendulum-v1", {}, False, False),
        ("tests/Rig-v0", {}, None, False),
        ("tests/Rig-v0", {}, True, True),
        ("no/Such-v0", {}, None, False),
    ],
)
def test_many_are_made_of_what_is_known_to_be_a_simulator(id, options, copies, expected):
    gymnasium.register("tests/Rig-v0", entry_point="my_rig:Rig")
    assert GymnasiumWorld(PENDULUM, GymnasiumConfig(id, options, copies)).copies is expected
    gymnasium.registry.pop("tests/Rig-v0")
