"""A simulated world: one step on tensors, in batches, behind gymnasium, and as a model."""

from __future__ import annotations

import math
from dataclasses import replace

import gymnasium as gym
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lopsided import LOPSIDED
from tensordict import TensorDict
from torchrl.envs import SerialEnv, check_env_specs

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.worlds import Plant, PlantPhysics, SimulatedConfig, SimulatedWorld, find_plant

from ..ids import TASKS, all_ids

INTEGRATORS = ["semi_implicit_euler", "rk4", "dopri5"]
all_tasks = pytest.mark.parametrize("name", list_tasks())


def draw(task, count=16, dtype=torch.float32):
    state = (task.coverage or task.reset).sample([count], dtype=dtype)
    unit = 2 * torch.rand(count, task.action_dim, dtype=dtype) - 1
    return state, task.bounds.from_unit(unit)


# Its step, its dynamics, its model


@pytest.mark.parametrize("integrator", INTEGRATORS)
@all_tasks
def test_the_oracle_and_the_model_are_the_world(name, integrator):
    task = get_task(name)
    world = SimulatedWorld(task, SimulatedConfig(integrator=integrator))
    state, action = draw(task)
    oracle, model = world.oracle(), world.model()
    expected = world.step(state, action)
    assert torch.equal(oracle(state, action), expected)
    assert list(oracle.parameters()) == []
    assert oracle.residual is None
    assert isinstance(oracle, HybridDynamics)
    assert isinstance(oracle.prior, PlantPhysics)
    assert isinstance(model, TaskWorldModel)
    next_state, reward, terminated = model.transition(state, action)
    assert torch.equal(next_state, expected)
    assert torch.equal(reward, task.reward(state, action, expected))
    assert torch.equal(terminated, task.is_terminated(expected))


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", ["pendulum", "cartpole-swingup", "acrobot-swingup"])
def test_a_prior_with_the_true_constants_is_the_world_without_friction(name, integrator):
    task = get_task(name)
    friction = dict.fromkeys(find_plant(task.system).coefficients, 0.0)
    world = SimulatedWorld(task, SimulatedConfig(integrator=integrator, friction=friction))
    state, action = draw(task)
    predicted = HybridDynamics.pure_prior(task, integrator=integrator)(state, action)
    torch.testing.assert_close(predicted, world.step(state, action), rtol=1e-4, atol=1e-4)


def test_substeps_are_those_of_its_integrator():
    task = get_task("acrobot-swingup")
    state, action = draw(task, dtype=torch.float64)
    whole, fine = (
        SimulatedWorld(task, SimulatedConfig("rk4", substeps=n)).step(state, action)
        for n in (1, 50)
    )
    exact = SimulatedWorld(task, SimulatedConfig("dopri5")).step(state, action)
    assert (fine - exact).abs().max() < 1e-3 * (whole - exact).abs().max()
    assert SimulatedWorld(task, SimulatedConfig("rk4", substeps=50)).oracle().config == {
        "prior": SimulatedWorld(task).oracle().config["prior"],
        "residual": None,
        "integrator": {"name": "rk4", "substeps": 50},
    }


@pytest.mark.parametrize("integrator", INTEGRATORS[:2])
@all_tasks
def test_splitting_a_batch_changes_nothing(name, integrator):
    task = get_task(name)
    world = SimulatedWorld(task, SimulatedConfig(integrator=integrator))
    state, action = draw(task, 12, torch.float64)
    whole = world.step(state, action)
    rows = [world.step(s, a) for s, a in zip(state, action, strict=True)]
    torch.testing.assert_close(torch.stack(rows), whole, rtol=1e-12, atol=1e-12)
    nested = world.step(state.reshape(3, 4, -1), action.reshape(3, 4, -1))
    torch.testing.assert_close(nested.reshape(12, -1), whole, rtol=1e-12, atol=1e-12)


@given(st.floats(0.5, 2.0), st.floats(0.0, 2.0))
def test_its_truth_may_differ_from_what_is_registered(mass, joint):
    config = SimulatedConfig(constants={"mass": mass}, friction={"joint": joint})
    world = SimulatedWorld("pendulum", config)
    assert world.truth.constants == {"gravity": 10.0, "mass": mass, "length": 1.0}
    assert world.truth.coefficients == {"joint": joint}
    assert world.task.system.constants["mass"] == 1.0  # what one knows is not touched
    state, action = torch.tensor([0.5, 1.0]).double(), torch.tensor([1.0]).double()
    rate = 15 * math.sin(0.5) + 3 / mass - joint / mass
    assert world.step(state, action)[1].item() == pytest.approx(1.0 + 0.05 * rate)


def test_it_says_what_it_is():
    world = SimulatedWorld("cartpole")
    assert (world.kind, str(world)) == ("simulated", "simulated")
    assert world.task is get_task("cartpole")
    assert isinstance(world.truth, Plant)


# Many worlds at once


@pytest.mark.parametrize("batch", [[], [3], [2, 3]])
@all_tasks
def test_specs_of_a_batch(name, batch):
    env = SimulatedWorld(name).make_batch(batch)
    check_env_specs(env, seed=0)
    check_env_specs(env, break_when_any_done=False)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
@all_tasks
def test_a_batch_is_the_world(name, integrator):
    task = get_task(name)
    world = SimulatedWorld(task, SimulatedConfig(integrator=integrator))
    data = world.make_batch([2, 3], seed=0).rollout(20, break_when_any_done=False)
    expected = world.step(data["state"], data["action"])
    torch.testing.assert_close(data["next", "state"], expected)
    reward = task.reward(data["state"], data["action"], expected)
    torch.testing.assert_close(data["next", "reward"].squeeze(-1), reward)


@all_ids
def test_a_batch_is_the_gymnasium_world(env_id):
    gym_env = gym.make(env_id)
    gym_env.reset(seed=0)
    env = SimulatedWorld(TASKS[env_id]).make_batch([])
    state = torch.tensor(gym_env.unwrapped.state, dtype=torch.float32)
    td = env.reset(TensorDict(state=state), set_state=True)
    for _ in range(10):
        td = env.step(env.rand_action(td))
        observation, reward, terminated, _, _ = gym_env.step(td["action"].numpy())
        close = {"atol": 1e-3, "rtol": 1e-3, "check_dtype": False}
        expected = torch.as_tensor(observation)
        torch.testing.assert_close(td["next", "observation"], expected, **close)
        torch.testing.assert_close(td["next", "reward"].item(), float(reward), **close)
        assert td["next", "terminated"].item() == terminated
        td = env.step_mdp(td)


def test_a_batch_counts_and_truncates():
    task = replace(get_task("pendulum"), max_steps=5)
    data = SimulatedWorld(task).make_batch([2], seed=0).rollout(100)
    assert data.shape == (2, 5)
    assert data["next", "truncated"][:, -1].all()
    assert not data["next", "terminated"].any()
    total = data["next", "reward"].sum(1)
    torch.testing.assert_close(data["next", "episode_reward"][:, -1], total)


def test_batches_in_series():
    env = SerialEnv(2, lambda: SimulatedWorld("cartpole").make_batch([3]))
    env.set_seed(0)
    data = env.rollout(60, break_when_any_done=False)
    assert data.shape == (2, 3, 60)
    assert len(data["state"][..., 0, :].flatten(0, 1).unique(dim=0)) == 6
    assert torch.equal(data["observation"], get_task("cartpole").observe(data["state"]))


# One environment, as every world has them


@pytest.mark.parametrize("task", [*map(get_task, list_tasks()), LOPSIDED], ids=lambda t: t.name)
def test_an_environment_is_the_world_step_by_step(task):
    world = SimulatedWorld(task, SimulatedConfig(integrator="rk4", substeps=2))
    env = world.make_env()
    check_env_specs(env, seed=0)
    env.set_seed(0)
    data = env.rollout(10)
    state = task.locate(data["observation"])
    expected = world.model().transition(state, data["action"])
    close = {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(
        data["next", "observation"], task.observe(expected.next_state), **close
    )
    torch.testing.assert_close(data["next", "reward"].squeeze(-1), expected.reward, **close)
    assert data["next", "step_count"].flatten().tolist() == list(range(1, len(data) + 1))
    assert {data[key].dtype for key in ("observation", "action")} == {torch.float32}


def test_an_environment_is_truncated_and_seeded():
    world = SimulatedWorld(replace(get_task("pendulum"), max_steps=4))
    first, again, other = (world.make_env() for _ in range(3))
    for env, seed in ((first, 0), (again, 0), (other, 1)):
        env.set_seed(seed)
    starts = [env.reset()["observation"] for env in (first, again, other)]
    assert torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[0], starts[2])
    data = first.rollout(100)
    assert data["next", "truncated"].flatten().tolist() == [False] * 3 + [True]
    assert not data["next", "terminated"].any()


@pytest.mark.parametrize(("low", "high"), [((-6.0,), (12.0,)), ((0.0,), (100.0,))])
def test_asymmetric_bounds_from_end_to_end(low, high):
    task = replace(get_task("pendulum"), action_low=low, action_high=high)
    world = SimulatedWorld(task)
    for env in (world.make_env(), world.make_batch([]), world.make_batch([64], seed=0)):
        spec = env.action_spec
        assert (spec.space.low == low[0]).all()
        assert (spec.space.high == high[0]).all()
        actions = env.rollout(20, break_when_any_done=False)["action"]
        assert ((actions >= low[0]) & (actions <= high[0])).all()
    assert actions.max() - actions.min() > 0.95 * (high[0] - low[0])
    state = task.reset.sample([2])
    far = torch.tensor([[-1e3], [1e3]])
    assert torch.equal(world.step(state, far), world.step(state, torch.tensor([low, high])))


# Bad input


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"integrator": "euler"}, "integrator"),
        ({"substeps": 0}, "substeps"),
        ({"substeps": 1.5}, "substeps"),
        ({"integrator": "dopri5", "substeps": 2}, "substeps"),
    ],
)
def test_settings_are_checked_by_name(options, key):
    with pytest.raises(ConfigError, match=f"^{key}: expected "):
        SimulatedConfig(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"constants": {"wind": 1.0}}, r"world\.constants: unknown \['wind'\], expected some of"),
        ({"friction": {"wind": 1.0}}, r"world\.friction: unknown \['wind'\], expected some of"),
        ({"constants": {"mass": math.nan}}, r"constants\.mass: expected a finite number, got nan"),
        ({"constants": {"mass": -1.0}}, r"world\.constants\.mass: expected a positive value"),
        ({"friction": {"joint": -1.0}}, r"world\.friction\.joint: expected a value >= 0"),
    ],
)
def test_what_is_not_true_of_the_system_is_named(options, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        SimulatedWorld("pendulum", SimulatedConfig(**options))


def test_an_unknown_task_is_named():
    with pytest.raises(ConfigError, match=r"^task: expected one of .*got 'no-such-task'"):
        SimulatedWorld("no-such-task")
