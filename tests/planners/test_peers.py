"""What TorchRL's tests ask of its own planners and world-model environments, asked of ours too.

Each test runs on the stock class and on ours. Deliberately different are:

- The stock ``WorldModelEnv`` passes on what a done head writes; ours makes a bool of it.
- A reset without a start raises a ``RuntimeError`` there, and here a ``ConfigError`` that names the
  keys; with ``start=`` ours can be reset.
- The stock planner ends sequences at ``"done"``, ours at ``"terminated"`` (``done_keys``).
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import (
    Binary,
    Composite,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, check_env_specs
from torchrl.envs.model_based import WorldModelEnv as StockWorldModelEnv
from torchrl.modules import CEMPlanner as StockCEMPlanner
from torchrl.modules import MPPIPlanner as StockMPPIPlanner
from torchrl.modules import ValueOperator, WorldModel
from torchrl.objectives.value import TDLambdaEstimator
from torchrl.testing.mocking_classes import MockBatchedUnLockedEnv

from phihp_torchrl import CEMPlanner, MPPIPlanner, WorldModelEnv

from .planner_parts import Concatenate
from .test_modules import UNIT, Line

ROWS, SEEN, LATENT, ACTION = 3, 8, 4, 2


# Planners.


@pytest.mark.parametrize("batch", [3, 5])
@pytest.mark.parametrize("planner_class", [StockCEMPlanner, CEMPlanner])
def test_a_planner_writes_an_action_and_nothing_else(planner_class, batch):
    torch.manual_seed(1)
    env = MockBatchedUnLockedEnv(device="cpu")
    planner = planner_class(env, planning_horizon=4, optim_steps=2, num_candidates=20, top_k=2)
    check_planner(env, planner, batch)


@pytest.mark.parametrize("batch", [3, 5])
@pytest.mark.parametrize("planner_class", [StockMPPIPlanner, MPPIPlanner])
def test_a_planner_by_advantage_writes_an_action_and_nothing_else(planner_class, batch):
    torch.manual_seed(1)
    env = MockBatchedUnLockedEnv(device="cpu")
    value = ValueOperator(nn.LazyLinear(1), in_keys=["observation"])
    module = TDLambdaEstimator(gamma=0.99, lmbda=0.95, value_network=value)
    value(env.reset())
    planner = planner_class(
        env,
        module,
        temperature=1.0,
        planning_horizon=4,
        optim_steps=2,
        num_candidates=20,
        top_k=2,
    )
    check_planner(env, planner, batch)


def check_planner(env, planner, batch):
    start = env.reset(TensorDict(batch_size=[batch]))
    found = planner(start.clone())
    action = found["action"]
    assert action.shape[-len(env.action_spec.shape) :] == env.action_spec.shape
    assert env.action_spec.is_in(action)
    assert set(found.keys()) == {*start.keys(), "action"}
    for key in start.keys():  # noqa: SIM118 (a tensordict, no dictionary)
        torch.testing.assert_close(found[key], start[key])


@pytest.mark.parametrize("planner_class", [StockCEMPlanner, CEMPlanner])
def test_a_locked_environment_is_refused(planner_class):
    class Locked(Line):
        batch_locked = True

    with pytest.raises(ValueError, match="batch_locked"):
        planner_class(Locked(UNIT), 2, 2, 8, 2)


# World models.


def linear_model(done_head=None):
    following = ("next", "latent")
    return WorldModel(
        encoder=TensorDictModule(nn.Linear(SEEN, LATENT), ["observation"], ["latent"]),
        dynamics=TensorDictModule(
            Concatenate(nn.Linear(LATENT + ACTION, LATENT)), ["latent", "action"], [following]
        ),
        reward_head=TensorDictModule(nn.Linear(LATENT, 1), [following], [("next", "reward")]),
        done_head=done_head and TensorDictModule(done_head, [following], [("next", "done")]),
    )


class Specs(EnvBase):
    """Only its specs are read."""

    def __init__(self, *batch, **observations):
        super().__init__(device="cpu", batch_size=batch)
        seen = {key: Unbounded((*batch, size)) for key, size in observations.items()}
        self.observation_spec = Composite(seen, shape=batch)
        self.action_spec, self.reward_spec = Unbounded((*batch, ACTION)), Unbounded((*batch, 1))
        self.done_spec = Binary(shape=(*batch, 1), dtype=torch.bool)

    def _reset(self, tensordict=None, **_):
        raise NotImplementedError

    def _step(self, tensordict):
        raise NotImplementedError

    def _set_seed(self, seed):
        raise NotImplementedError


def stock_env(model):
    return StockWorldModelEnv(model, base_env=Specs(ROWS, latent=LATENT))


def our_env(model):
    return WorldModelEnv.from_world_model(model, Specs(latent=LATENT))


ENVS = pytest.mark.parametrize("make", [stock_env, our_env])
POLICY = TensorDictModule(nn.Linear(LATENT, ACTION), ["latent"], ["action"])


def start_of(model, rows=ROWS):
    return model.encode(TensorDict(observation=torch.randn(rows, SEEN), batch_size=[rows]))


@ENVS
def test_rollouts_have_the_shape_and_the_reward(make):
    model = linear_model()
    out = make(model).rollout(5, POLICY, tensordict=start_of(model))
    assert out.shape == (ROWS, 5)
    assert ("next", "reward") in out.keys(include_nested=True)
    assert not out["next", "done"].any()


@ENVS
def test_a_rollout_stops_where_the_model_ends_it(make):
    model = linear_model(lambda latent: torch.ones_like(latent[..., :1], dtype=torch.bool))
    out = make(model).rollout(10, POLICY, tensordict=start_of(model), break_when_any_done=True)
    assert out.shape[1] == 1


@ENVS
def test_a_rollout_goes_into_a_replay_buffer(make):
    model = linear_model()
    flat = make(model).rollout(5, POLICY, tensordict=start_of(model)).reshape(-1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100))
    buffer.extend(flat)
    assert len(buffer) == 5 * ROWS


@ENVS
def test_a_reset_needs_a_start(make):
    with pytest.raises((RuntimeError, ValueError), match="latent"):
        make(linear_model()).reset()


def test_ours_takes_every_batch_and_observations_too():
    model = linear_model()
    env = WorldModelEnv.from_world_model(
        model,
        Specs(observation=SEEN),
        start=lambda batch: TensorDict(observation=torch.randn(*batch, SEEN), batch_size=batch),
    )
    check_env_specs(env)
    start = TensorDict(observation=torch.randn(2, 5, SEEN), batch_size=[2, 5])
    reset = env.reset(start)
    torch.testing.assert_close(reset["latent"], model.encode(start)["latent"])
    assert env.rollout(3, tensordict=start).shape == (2, 5, 3)
    old = env.step(env.rand_action(reset))["next"].exclude("reward")
    mask = torch.zeros(2, 5, 1, dtype=torch.bool)
    mask[0] = True
    fresh = env.reset(old.clone().set("_reset", mask))["latent"]
    assert torch.equal(fresh[1], old["latent"][1])
    assert not torch.equal(fresh[0], old["latent"][0])


@pytest.mark.parametrize(("done", "limit"), [("probability", 0.5), ("logit", 0.0)])
def test_what_a_done_head_writes_becomes_a_bool(done, limit):
    model = linear_model(lambda latent: latent[..., :1])
    env = WorldModelEnv.from_world_model(model, Specs(latent=LATENT), done=done)
    start = start_of(model, 20)
    step = env.step(POLICY(env.reset(start)))["next"]
    assert torch.equal(step["done"], step["latent"][..., :1] > limit)
    assert torch.equal(step["done"], step["terminated"])


def test_what_does_not_fit_is_named():
    model = linear_model()
    with pytest.raises(ValueError, match=r"^base_env: expected an environment with the specs"):
        WorldModelEnv.from_world_model(model)
    with pytest.raises(ValueError, match=r"^base_env: expected observations .*observation"):
        WorldModelEnv.from_world_model(model, Specs(other=SEEN))
    model = linear_model()
    model.encoder.out_keys = ["elsewhere"]
    with pytest.raises(ValueError, match=r"^world_model: expected an encoder that writes"):
        WorldModelEnv.from_world_model(model, Specs(observation=SEEN))
