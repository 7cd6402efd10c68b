"""Actors, critics and environments of every shape and dtype: right, or refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Binary, Bounded, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase

from phihp_torchrl import CEMPlanner, MPPIPlanner
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.tasks import ActionBounds

from .planner_parts import make_planner, noise_for, task_parts


class Shaped(nn.Module):
    """A value that tells the rows apart, or an action, in a shape of its own."""

    def __init__(self, shape):
        super().__init__()
        self.shape = shape

    def forward(self, observation, action=None):
        rows = len(observation)
        sizes = [rows if size == "rows" else size for size in self.shape]
        value = observation.sum(-1) if action is None else action.sum(-1)
        repeats = int(np.prod(sizes)) // rows
        if self.shape and self.shape[-1] == 1 and repeats > 1:
            return value.expand(repeats, rows).reshape(sizes)
        return value.repeat_interleave(repeats).reshape(sizes)


SIZES = st.lists(st.sampled_from(["rows", 1, 2]), min_size=0, max_size=4)


@settings(max_examples=30, deadline=None)
@given(SIZES.filter(lambda shape: shape.count("rows") == 1), st.sampled_from(["tensor", "env"]))
def test_values_of_any_shape_are_right_or_refused(shape, backend):
    _, env, actor, _ = task_parts("pendulum")
    kwargs = {"backend": backend, "optim_steps": 1, "planning_horizon": 1}
    critic = TensorDictModule(Shaped(shape), ["observation", "action"], ["state_action_value"])
    right = TensorDictModule(Shaped(["rows", 1]), ["observation", "action"], ["state_action_value"])
    tensordict = env.reset(TensorDict(batch_size=[3]))
    planner = make_planner(env, actor, critic, **kwargs)
    noise = noise_for(planner, (3,))
    if shape in (["rows", 1], ["rows", 2], [1, "rows", 1], [2, "rows", 1]):
        expected = make_planner(env, actor, right, **kwargs).plan(tensordict, noise)
        torch.testing.assert_close(planner.plan(tensordict, noise).score, expected.score)
    else:
        with pytest.raises(ValueError, match="qvalue: expected 'state_action_value' of shape"):
            planner.plan(tensordict, noise)


@pytest.mark.parametrize("shape", [[1, "rows"], [1, "rows", 1], ["rows", 2]])
def test_actions_of_another_shape_are_refused(shape):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, TensorDictModule(Shaped(shape), ["observation"], ["action"]))
    with pytest.raises(ValueError, match="actor: expected 'action' of shape"):
        planner(env.reset(TensorDict(batch_size=[3])))


class Line(EnvBase):
    """A point on a line, with specs of one's own; it may work in place."""

    batch_locked = False

    def __init__(self, action, reward=torch.float32, flag=torch.bool, seen=torch.float32, **kwargs):
        super().__init__(device="cpu")
        self.observation_spec = Composite(observation=Unbounded(2, dtype=seen), idle=Unbounded(2))
        self.state_spec = Composite(observation=Unbounded(2, dtype=seen))
        self.action_spec, self.flag = action, flag
        self.reward_spec = Unbounded(1, dtype=reward)
        self.done_spec = Composite(terminated=Binary(1, dtype=torch.bool))
        self.in_place = kwargs.get("in_place", False)
        self.goal = kwargs.get("goal", 0.5)

    def _reset(self, tensordict=None, **_):
        batch = torch.Size([]) if tensordict is None else tensordict.batch_size
        seen = self.observation_spec["observation"].zero(batch)
        return TensorDict(
            observation=seen, idle=torch.full((*batch, 2), torch.nan), batch_size=batch
        )

    def _step(self, tensordict):
        batch, seen = tensordict.batch_size, tensordict["observation"]
        rows = batch.numel()
        change = tensordict["action"].reshape(*batch, -1 if rows else 1).sum(-1, keepdim=True)
        if self.in_place:
            seen.add_(change)
            tensordict["action"].zero_()
        else:
            seen = seen + change.to(seen.dtype)
        reward = (-10 * (seen - self.goal).abs().sum(-1, keepdim=True)).to(self.reward_spec.dtype)
        over = (seen.abs() > 50).any(-1, keepdim=True).to(self.flag)
        idle = torch.full((*batch, 2), torch.nan)
        found = {"observation": seen, "reward": reward, "terminated": over, "done": over}
        return TensorDict({**found, "idle": idle}, batch_size=batch)

    def _set_seed(self, seed):
        pass


UNIT = Bounded(-torch.ones(1), torch.ones(1))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"action": UNIT},
        {"action": UNIT, "reward": torch.int64},
        {"action": UNIT, "flag": torch.float32},
        {"action": UNIT, "flag": torch.uint8},
        {"action": Bounded(-1.0, 1.0, shape=())},
        {"action": UNIT, "seen": torch.float64},
        {"action": Bounded(-torch.ones(1).double(), torch.ones(1).double())},
        {"action": UNIT, "in_place": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("batch", [(), (3,), (0,), (2, 0)])
def test_environments_of_other_dtypes_and_empty_batches(kwargs, batch):
    """What nobody reads may be NaN, and the observations that are planned from stay as they are."""
    env = Line(**kwargs)
    generator = torch.Generator().manual_seed(0)
    config = MPPIConfig(3, 3, 32, 4, num_policy_candidates=0)
    for planner in (
        make_planner(env, generator=generator, optim_steps=3),
        MPPIPlanner(env, config, generator=generator),
    ):
        start = env.reset(TensorDict(batch_size=batch))
        before = start.clone()
        action = planner(start)["action"]
        assert action.shape == (*batch, *env.action_spec.shape)
        assert action.dtype == env.action_spec.dtype
        assert torch.equal(start["observation"], before["observation"])
        assert ((action - 0.5).abs() < 0.3).all(), "it goes to its goal"


def test_what_a_plan_reads_must_be_finite_unless_told():
    env = Line(UNIT)
    start = env.reset().set("observation", torch.tensor([0.0, torch.nan]))
    with pytest.raises(ValueError, match="observation: expected finite"):
        make_planner(env)(start)
    assert make_planner(env, check_finite=False)(start)["action"].abs() <= 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.bool, torch.int64])
def test_discrete_actions_are_refused_whatever_their_dtype(dtype):
    with pytest.raises(ValueError, match=r"env: expected continuous actions, got .* OneHot"):
        make_planner(Line(OneHot(3, dtype=dtype)))


# Bounds.

LIMIT = st.one_of(st.just(torch.inf), st.just(torch.finfo(torch.float32).max), st.floats(-99, 99))


@settings(max_examples=30, deadline=None)
@given(low=LIMIT.map(lambda x: -x), high=LIMIT)
def test_samples_of_any_bounds_are_inside_them_and_differ(low, high):
    if not low + 0.1 < high:
        return
    bounds = ActionBounds.from_limits(torch.tensor([low]), torch.tensor([high]))
    normal = torch.linspace(-2, 2, 9).unsqueeze(-1)
    actions = bounds.clip(bounds.from_unit(normal))
    assert actions.isfinite().all()
    assert ((actions >= bounds.low) & (actions <= bounds.high)).all()
    assert len(actions.unique()) >= 4


@pytest.mark.parametrize(("low", "high"), [(2.0, torch.inf), (-torch.inf, -3.0), (0.0, torch.inf)])
def test_an_action_with_one_bound_is_not_frozen_there(low, high):
    goal = low + 1 if high == torch.inf else high - 1
    env = Line(Bounded(torch.full((1,), low), torch.full((1,), high)), goal=goal)
    planner = make_planner(env, optim_steps=4, planning_horizon=1)
    assert abs(planner(env.reset())["action"].item() - goal) < 0.2


# Numbers, and doubles.


def test_numbers_of_numpy_are_numbers():
    _, env, _, _ = task_parts("pendulum")
    sizes = [np.int64(4), np.int32(2), np.int64(16), torch.tensor(4)]
    planner = CEMPlanner(env, *sizes, gamma=np.float32(0.5), warm_start=np.bool_(True))
    assert planner.settings == CEMConfig(
        4, 2, 16, 4, num_policy_candidates=0, gamma=0.5, warm_start=True
    )
    assert all(type(v) in (int, float, bool, str) for v in vars(planner.settings).values())


@pytest.mark.parametrize("backend", ["tensor", "env"])
def test_doubles(backend):
    _, env, actor, qvalue = task_parts("pendulum")
    planner = make_planner(env, actor, qvalue, backend=backend).double()
    start = env.reset()
    assert start["observation"].dtype == torch.float64
    assert planner(start)["action"].dtype == torch.float64
    with pytest.raises(ValueError, match=r"observation: expected torch\.float64"):
        planner(TensorDict(observation=start["observation"].float()))
    assert planner.float()(env.reset())["action"].dtype == torch.float32


def test_doubles_on_an_environment_of_floats_are_refused():
    with pytest.raises(ValueError, match=r"dtype: expected torch\.float32, as actions of Line"):
        make_planner(Line(UNIT)).double()
