"""Imagination as an environment keeps TorchRL's contracts and agrees with what is beneath."""

from __future__ import annotations

import copy
import warnings
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import StepCounter, TransformedEnv, check_env_specs
from torchrl.modules import MLP, CEMPlanner, TanhModule

from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import BoxStates, make_start_states
from phihp_torchrl.tasks import Box, Task, find_task, list_tasks
from phihp_torchrl.worlds import SimulatedWorld

BATCHES = [[], [3], [2, 3]]


def make_env(task: str | Task = "pendulum", **kwargs) -> WorldModelEnv:
    task = find_task(task)
    return WorldModelEnv(TaskWorldModel(task, HybridDynamics.hybrid(task)), **kwargs)


# Specs


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("name", list_tasks())
def test_specs(name, batch):
    env = make_env(name, batch_size=batch)
    check_env_specs(env, seed=0)
    check_env_specs(env, break_when_any_done=False)


@pytest.mark.parametrize("batch", BATCHES)
def test_specs_from_the_task(batch):
    env, task = make_env("acrobot-swingup", batch_size=batch), get_task("acrobot-swingup")
    assert env.batch_size == torch.Size(batch)
    assert env.observation_spec["observation"].shape == (*batch, 6)
    assert env.observation_spec["state"].shape == (*batch, 4)
    assert "state" in env.state_spec
    assert env.action_spec.shape == (*batch, task.action_dim)
    assert (env.action_spec.high == 1).all()
    assert (env.action_spec.low == -1).all()
    assert set(env.full_done_spec.keys()) == {"done", "terminated"}
    assert env.tensor_model.task is task


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("low", "high"), [((-6.0,), (12.0,)), ((0.0,), (100.0,))])
def test_asymmetric_bounds_are_in_the_specs_and_hold(batch, low, high):
    env = make_env(
        replace(get_task("pendulum"), action_low=low, action_high=high), batch_size=batch, seed=0
    )
    check_env_specs(env, seed=0)
    assert env.action_spec.shape == (*batch, 1)
    assert (env.action_spec.space.low == low[0]).all()
    assert (env.action_spec.space.high == high[0]).all()
    actions = env.rollout(200)["action"]
    assert ((actions >= low[0]) & (actions <= high[0])).all()
    assert actions.max() - actions.min() > 0.9 * (high[0] - low[0])
    start = env.reset()
    ends = []
    for torque in (-1e3, low[0], 1e3, high[0]):
        action = torch.full((*batch, 1), torque)
        ends.append(env.step(start.clone().set("action", action))["next", "state"])
    assert torch.equal(ends[0], ends[1])
    assert torch.equal(ends[2], ends[3])
    assert not torch.equal(ends[0], ends[2])


@pytest.mark.parametrize("name", ["cartpole", "acrobot-swingup"])
def test_splitting_a_batch_changes_nothing(name):
    env = make_env(name)
    start = env.rand_action(env.reset(TensorDict(batch_size=[2, 3])))
    whole = env.step(start.clone())["next"]
    for i in range(2):
        part = env.step(start[i].clone())["next"]
        for key in ("state", "observation", "reward", "terminated"):
            torch.testing.assert_close(part[key], whole[key][i])


# Seeds


def test_seed_reproduces_resets():
    def starts(env) -> torch.Tensor:
        return torch.stack([env.reset()["state"] for _ in range(3)])

    first = starts(make_env(batch_size=[4], seed=1))
    assert torch.equal(first, starts(make_env(batch_size=[4], seed=1)))
    assert not torch.equal(first, starts(make_env(batch_size=[4], seed=2)))
    env = SimulatedWorld("pendulum").make_batch([4], seed=7)
    env.set_seed(1)
    assert torch.equal(first, starts(env)), "the world and the imagination start alike"
    assert len(first.flatten(0, 1).unique(dim=0)) == 12, "every world and every episode differs"


def test_unseeded_envs_follow_the_global_seed():
    def start() -> torch.Tensor:
        return make_env(batch_size=[4]).reset()["state"]

    torch.manual_seed(0)
    first, second = start(), start()
    torch.manual_seed(0)
    assert torch.equal(first, start())
    assert not torch.equal(first, second)


def test_resets_leave_the_global_generator_alone():
    env = make_env(batch_size=[4], seed=0)
    before = torch.get_rng_state()
    env.reset()
    assert torch.equal(before, torch.get_rng_state())


def test_generator_state_resumes():
    env = make_env(batch_size=[4], seed=0)
    env.reset()
    saved = env.generator.get_state()
    expected = env.reset()["state"]
    other = make_env(batch_size=[4], seed=5)
    other.generator.set_state(saved)
    assert torch.equal(other.reset()["state"], expected)


# Resets


def test_start_states_are_used():
    box = BoxStates(Box(low=(1.0, 2.0), high=(1.5, 2.5)))
    state = make_env(batch_size=[100], start_states=box).reset()["state"]
    assert ((state >= torch.tensor(box.box.low)) & (state <= torch.tensor(box.box.high))).all()
    task = get_task("cartpole-swingup")
    env = make_env(task.name, batch_size=[2, 50], start_states=make_start_states(task), seed=0)
    assert env.reset()["state"].flatten(0, 1).std(0).min() > 0.5


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("batch", [[], [3]])
def test_reset_from_what_is_given(batch, wrap):
    env = make_env("acrobot", batch_size=batch, seed=0)
    if wrap:
        env = TransformedEnv(env, StepCounter(10))
    state = torch.rand(*batch, 4)
    observation = env.tensor_model.observe(state)
    for given in ({"state": state}, {"observation": observation}):
        start = env.reset(TensorDict(given, batch_size=batch), set_state=True)
        torch.testing.assert_close(start["state"], state)
        torch.testing.assert_close(start["observation"], observation)
        assert not start["done"].any()
        ignored = env.reset(TensorDict(given, batch_size=batch), set_state=False)
        assert not torch.allclose(ignored["state"], state)


def test_a_given_start_needs_no_flag():
    env = make_env(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        start = env.reset(TensorDict(observation=torch.tensor([[0.0, 1.0, 0.5]]), batch_size=[1]))
        torch.testing.assert_close(start["state"], torch.tensor([[torch.pi / 2, 0.5]]))
        rollout = env.rollout(3, tensordict=start.select("observation"))
        torch.testing.assert_close(rollout["state"][:, 0], start["state"])
        assert env.reset()["state"].shape == (2,)


@pytest.mark.parametrize("wrap", [False, True])
def test_partial_reset(wrap):
    env = make_env("cartpole", batch_size=[5], seed=0)
    if wrap:
        env = TransformedEnv(env, StepCounter(10))
    old = env.step_mdp(env.step(env.rand_action(env.reset())))
    mask = torch.tensor([True, False, True, False, False])
    new = env.reset(old.clone().set("_reset", mask.unsqueeze(-1)))
    kept = (new["state"] == old["state"]).all(-1)
    assert torch.equal(kept, ~mask)
    assert torch.equal(new["observation"], env.tensor_model.observe(new["state"]))
    assert (new["state"][mask].abs() <= 0.05).all()
    assert "_reset" not in new


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_env("cartpole", batch_size=[8], seed=0),
        lambda: SimulatedWorld("cartpole").make_batch([8], seed=0),
    ],
    ids=["imagined", "simulated"],
)
def test_auto_reset_keeps_latent_and_observation_together(make):
    env = make()
    torch.manual_seed(0)
    data = env.rollout(100, break_when_any_done=False)
    done = data["next", "done"].squeeze(-1)
    assert done.any(1).all(), "every world should have fallen at least once"
    for td in (data, data["next"]):
        assert torch.equal(td["observation"], env.tensor_model.observe(td["state"]))
    going = ~done[:, :-1]
    start, end = data["state"][:, 1:], data["next", "state"][:, :-1]
    assert torch.equal(start[going], end[going])
    fresh = start[~going]
    assert (fresh.abs() <= 0.05).all()
    assert len(fresh.unique(dim=0)) == len(fresh)
    assert not data["done"].any()


@pytest.mark.parametrize("batch", [[], [6], [2, 3]])
def test_rollout_until_all_are_done(batch):
    env = make_env("cartpole", batch_size=batch, seed=0)
    torch.manual_seed(0)
    for start in (env.reset(), env.reset(TensorDict(batch_size=batch or [6]))):
        data = env.rollout(200, tensordict=start, break_when_all_done=True)
        assert data["next", "terminated"][..., -1, :].all()
        assert data.shape[:-1] == start.shape


# Steps


@pytest.mark.parametrize("name", list_tasks())
def test_steps_are_the_models_transition(name):
    env = make_env(name, batch_size=[16], seed=0, start_states=make_start_states(get_task(name)))
    data = env.rollout(5, break_when_any_done=False)
    model = env.tensor_model
    state, reward, terminated = model.transition(data["state"], data["action"])
    torch.testing.assert_close(data["next", "state"], state)
    torch.testing.assert_close(data["next", "reward"].squeeze(-1), reward)
    assert torch.equal(data["next", "terminated"].squeeze(-1), terminated)
    assert torch.equal(data["next", "done"], data["next", "terminated"])
    forward = model(data.select("observation", "action"))["next"]
    # By way of the observation the angles come back wrapped, and rounded.
    for key in ("observation", "reward"):
        torch.testing.assert_close(forward[key], data["next", key], atol=1e-4, rtol=1e-4)


def test_termination_is_not_truncation():
    env = TransformedEnv(make_env("acrobot", batch_size=[2]), StepCounter(2))
    up = torch.tensor([[3.1, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    td = env.reset(TensorDict(state=up, batch_size=[2]), set_state=True)
    assert not td["done"].any(), "a start is never an end"
    td = env.step(td.set("action", torch.zeros(2, 1)))["next"]
    assert td["terminated"].squeeze(-1).tolist() == [True, False]
    assert td["truncated"].squeeze(-1).tolist() == [False, False]
    assert td["reward"].squeeze(-1).tolist() == [0.0, -1.0]
    data = TransformedEnv(make_env(batch_size=[3]), StepCounter(4)).rollout(
        12, break_when_any_done=False
    )
    assert not data["next", "terminated"].any()
    assert torch.equal(data["next", "truncated"], data["next", "done"])
    ends = data["next", "done"].squeeze(-1)
    assert ends.nonzero()[:, 1].unique().tolist() == [3, 7, 11]


def test_unlocked_env_takes_any_batch():
    env = make_env(seed=0)
    assert not env.batch_locked
    for shape in ([], [4], [4, 5], [1, 2, 3]):
        td = env.reset(TensorDict(batch_size=shape))
        assert td["state"].shape == (*shape, 2)
        td.set("action", torch.zeros(*shape, 1))
        assert env.step(td)["next", "reward"].shape == (*shape, 1)
    with pytest.raises(RuntimeError, match="batch_size"):
        make_env(batch_size=[3]).step(td)


def test_step_from_an_observation_alone():
    env = make_env("acrobot")
    state = torch.rand(5, 4)
    td = TensorDict(action=torch.rand(5, 1), batch_size=[5])
    by_state = env.step(td.clone().set("state", state))["next"]
    by_observation = env.step(td.clone().set("observation", env.tensor_model.observe(state)))[
        "next"
    ]
    for key in ("state", "observation", "reward"):
        torch.testing.assert_close(by_state[key], by_observation[key])


def test_model_is_shared_and_differentiable():
    env = make_env("cartpole", batch_size=[4], seed=0)
    env.rollout(3)["next", "state"].sum().backward()
    parameters = list(env.tensor_model.dynamics.parameters())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in parameters)
    start = env.reset().set("action", torch.ones(4, 1))
    before = env.step(start.clone())["next", "state"]
    with torch.no_grad():
        parameters[0].add_(0.5)
    assert not torch.allclose(before, env.step(start.clone())["next", "state"])


# What drives it


def make_actor(env) -> TensorDictSequential:
    task = env.tensor_model.task
    net = MLP(in_features=task.observation_dim, out_features=task.action_dim, depth=1)
    head = TanhModule(
        in_keys=["action"], low=-torch.tensor(task.action_high), high=torch.tensor(task.action_high)
    )
    return TensorDictSequential(TensorDictModule(net, ["observation"], ["action"]), head)


@pytest.mark.parametrize("batch", BATCHES)
@torch.no_grad()
def test_rollout_with_an_actor(batch):
    env = make_env("cartpole-swingup", batch_size=batch, seed=0)
    actor = make_actor(env)
    data = env.rollout(10, actor)
    assert data.shape == (*batch, 10)
    assert data["action"].abs().max() <= 10
    torch.testing.assert_close(actor(data.select("observation"))["action"], data["action"])


@pytest.mark.parametrize("batch", BATCHES)
def test_collector(batch):
    env = TransformedEnv(make_env("cartpole", batch_size=batch, seed=0), StepCounter(30))
    worlds = env.batch_size.numel()
    collector = Collector(env, make_actor(env), frames_per_batch=60 * worlds, total_frames=-1)
    try:
        data = next(iter(collector))
    finally:
        collector.shutdown()
    assert data.shape == (*batch, 60)
    assert torch.equal(data["observation"], env.tensor_model.observe(data["state"]))
    ends = data["next", "done"].sum().item()
    assert data["collector", "traj_ids"].unique().numel() >= ends > 0
    assert not data.requires_grad


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_stock_planner(name):
    task = get_task(name)
    planner = CEMPlanner(make_env(name, seed=0), 5, 2, 16, 4)
    for batch in BATCHES:
        observation = task.observe(task.reset.sample(batch))
        action = planner(TensorDict(observation=observation, batch_size=batch))["action"]
        assert action.shape == (*batch, task.action_dim)
        assert (action.abs() <= torch.tensor(task.action_high)).all()
    assert SimulatedWorld(task).make_batch([2]).rollout(3, planner).shape == (2, 3)


def test_deepcopy():
    env = make_env(batch_size=[3], seed=0)
    twin = copy.deepcopy(env)
    assert torch.equal(env.reset()["state"], twin.reset()["state"])


# Bad input


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("action", torch.zeros(3, 2)),
        ("action", torch.zeros(3, 1, dtype=torch.float64)),
        ("action", torch.zeros(3, 1, device="meta")),
        ("state", torch.zeros(3, 3)),
        ("state", torch.zeros(3, 2, dtype=torch.int64)),
    ],
)
def test_bad_step_is_named(key, value):
    env = make_env(batch_size=[3])
    td = env.rand_action(env.reset())
    td = TensorDict({**td, key: value}, batch_size=[3])
    with pytest.raises(ValueError, match=rf"^{key}: expected torch.float32 of shape \[3, \d\]"):
        env.step(td)


def test_bad_reset_is_named():
    env = make_env(batch_size=[3])
    for key, value in (("observation", torch.zeros(3, 2)), ("state", torch.zeros(3, 3))):
        with pytest.raises(ValueError, match=rf"^{key}: expected .* shape \[3, \d\]"):
            env.reset(TensorDict({key: value}, batch_size=[3]))
    with pytest.raises(ValueError, match="finite"):
        env.reset(TensorDict(state=torch.full((3, 2), float("nan")), batch_size=[3]))
    with pytest.raises(ValueError, match=r"action: .* got none"):
        env.step(env.reset())
    with pytest.raises(ValueError, match=r"observation: .* got none"):
        env.reset(TensorDict(batch_size=[3]), set_state=True)
    with pytest.raises(ValueError, match=r"start_states: expected .* \[3, 2\]"):
        make_env(batch_size=[3], start_states=BoxStates(Box((0.0,), (1.0,)))).reset()


def test_an_empty_batch_is_refused():
    with pytest.raises(ValueError, match=r"batch_size: .* got \[3, 0\]"):
        make_env(batch_size=[3, 0])


def test_other_world_models_are_refused():
    with pytest.raises(TypeError, match="world_model: expected a TaskWorldModel, got Linear"):
        WorldModelEnv(nn.Linear(1, 1))
