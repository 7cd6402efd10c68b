"""Guards end an episode of any world at the step that crosses them, as a truncation."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from torchrl.envs import EnvBase, GymWrapper

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.worlds import (
    EnvWorld,
    GuardedWorld,
    SimulatedWorld,
    guard_env,
    make_limited_env,
    read_guards,
)

CARTPOLE = get_task("cartpole-swingup")


def push(tensordict):
    return tensordict.set("action", torch.tensor([10.0]))


def test_an_environment_without_truncations_gets_them():
    world = EnvWorld(CARTPOLE, SimulatedWorld(CARTPOLE).make_env)
    env = world.make_env()
    crossings = Counter()
    guarded = guard_env(env, CARTPOLE, {"x": 0.3}, crossings)
    rollout = guarded.rollout(100, push, break_when_any_done=False)
    x, done = rollout["next", "observation"][:, 0], rollout["next", "done"][:, 0]
    assert torch.equal(done, x.abs() > 0.3)
    assert torch.equal(rollout["next", "truncated"][:, 0], done)
    assert not rollout["next", "terminated"].any()
    assert crossings == {"x above 0.3": int(done.sum())}
    assert len(rollout) == 100, "it goes on from resets"
    assert guard_env(env, CARTPOLE, {}, crossings) is env


def test_an_environment_of_others_is_not_changed():
    env = SimulatedWorld(CARTPOLE).make_env()
    guard_env(env, CARTPOLE, {"x": 0.2}, Counter())
    assert len(env.rollout(60, push)) == 60


def test_a_value_that_is_no_number_ends_an_episode():
    class Broken(EnvBase):
        def __init__(self):
            like = GymWrapper(make_limited_env(CARTPOLE))
            super().__init__()
            self.observation_spec = like.observation_spec.clone()
            self.action_spec, self.reward_spec = like.action_spec, like.reward_spec
            self.done_spec = like.full_done_spec.clone()

        def _reset(self, tensordict=None, **_):
            return self.full_observation_spec.zero().update(self.full_done_spec.zero())

        def _step(self, tensordict):
            out = self._reset().update(self.full_reward_spec.zero())
            return out.set("observation", torch.full((5,), torch.nan))

        def _set_seed(self, seed):
            pass

    crossings = Counter()
    env = guard_env(EnvWorld(CARTPOLE, Broken).make_env(), CARTPOLE, {"x": 1.0}, crossings)
    assert len(env.rollout(10)) == 1
    assert crossings == {"x not a number": 1}


def test_limits_are_read_and_refused_by_name():
    assert read_guards(CARTPOLE, {"x_dot": [-3.0, 2.0]}) == {"x_dot": (-3.0, 2.0)}
    for guards in ({"y": 1.0}, {"x": (1.0, -1.0)}, {"x": 0.0}, {"x": (0.5, 2.0)}):
        with pytest.raises(ConfigError, match=rf"guards\.{next(iter(guards))}: expected"):
            GuardedWorld(SimulatedWorld(CARTPOLE), guards)


def test_a_guarded_world_is_the_world_otherwise():
    world = EnvWorld(CARTPOLE, SimulatedWorld(CARTPOLE).make_env, label="my rig")
    guarded = GuardedWorld(world, {"x": 0.5})
    assert str(guarded) == "my rig"
    assert guarded.truth is None
    env = guarded.make_env(render=True)
    assert guarded.picture(env) is None
    assert len(env.rollout(100, push)) < 100
    assert guarded.crossings.total() == 1
