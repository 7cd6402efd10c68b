"""Worlds that know nothing of references get them, and their measured inputs are read."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld, make_world
from tests.followed import AIM, Calm, Mass, followed

PLAIN = replace(
    followed(), reference=None, reward=lambda s, a, following: torch.ones_like(s[..., 0])
)
PREVIEWED = followed(reference=replace(AIM, preview=2))


def foreign():
    return SimulatedWorld(PLAIN).make_env()


class Measured(Transform):
    """Shows a wind, which blows harder at each step."""

    def _reset(self, tensordict, tensordict_reset):
        self.wind = torch.zeros(1)
        return tensordict_reset.set("inputs", self.wind)

    def _step(self, tensordict, next_tensordict):
        self.wind = self.wind + 0.25
        return next_tensordict.set("inputs", self.wind)

    def transform_observation_spec(self, observation_spec):
        observation_spec["inputs"] = Unbounded(1)
        return observation_spec


def test_references_are_drawn_shown_and_change():
    torch.manual_seed(0)
    env = EnvWorld(PREVIEWED, foreign).make_env()
    check_env_specs(env)
    rollout = env.rollout(40, break_when_any_done=False)
    seen = rollout["next", "observation"]
    assert seen.shape == (40, 5)
    assert seen[:19, 3:].equal(rollout["next", "observation"][1:20, 2:4])
    assert seen[:, 2].std() > 0


def test_the_reward_is_that_of_the_task():
    torch.manual_seed(0)
    rollout = EnvWorld(PREVIEWED, foreign).make_env().rollout(20)
    expected = -(rollout["next", "observation"][:, :1] - rollout["observation"][:, 3:4]).square()
    assert torch.allclose(rollout["next", "reward"], expected, atol=1e-5)


def test_an_episode_draws_its_own_reference_and_a_seed_the_same():
    env = EnvWorld(followed(), foreign).make_env()
    torch.manual_seed(1)
    first = env.reset()["observation"][2:]
    assert not env.reset()["observation"][2:].equal(first)
    torch.manual_seed(1)
    assert env.reset()["observation"][2:].equal(first)


def test_measured_inputs_are_read_and_missing_ones_refused():
    task = followed(Mass(), actuator=Actuator(delay_steps=1.0))
    env = EnvWorld(task, lambda: TransformedEnv(foreign(), Measured())).make_env()
    rollout = env.rollout(4)
    wind = task.locate(rollout["observation"])[:, 2]
    assert torch.allclose(wind, torch.tensor([0.0, 0.25, 0.5, 0.75]))
    assert rollout["observation"].shape == (4, task.observation_dim)
    with pytest.raises(ConfigError, match=r"^world: expected 'inputs' of shape \[1\] \(wind\)"):
        EnvWorld(task, foreign).make_env()


def test_a_world_that_shows_its_references_keeps_them():
    world = make_world(PREVIEWED, lambda: SimulatedWorld(PREVIEWED).make_env())
    rollout = world.make_env().rollout(5)
    assert rollout["observation"].shape == (5, 5)
    assert isinstance(PREVIEWED.system, Calm)
