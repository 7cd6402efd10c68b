"""One episode in full, in whatever world, and its pictures."""

from __future__ import annotations

import importlib.util
import math
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from phihp_torchrl import get_task
from phihp_torchrl.evaluation import evaluate, evaluation_seed, play_episode
from phihp_torchrl.evaluation.episode import _prepare_pygame, draw_episode
from phihp_torchrl.worlds import (
    EnvWorld,
    GymnasiumConfig,
    GymnasiumWorld,
    SimulatedConfig,
    SimulatedWorld,
)

from .policies import balance, constant

PENDULUM = get_task("pendulum")


def test_an_episode_is_what_was_evaluated():
    task = get_task("cartpole")
    episode = play_episode(balance(), task, max_steps=50)
    assert episode.states.shape == (51, 4)
    assert episode.actions.shape == (50, 1)
    assert episode.total_reward == 50.0
    assert not episode.terminated
    assert episode.frames.size == 0
    states = torch.from_numpy(episode.states)
    expected = SimulatedWorld(task).step(states[:-1], torch.from_numpy(episode.actions))
    torch.testing.assert_close(states[1:], expected, rtol=0, atol=1e-5)  # seen in float32
    fallen = play_episode(constant(), task)
    assert fallen.terminated
    assert len(fallen.rewards) < 200
    again = play_episode(balance(), task, max_steps=50)
    assert np.array_equal(again.states, episode.states)
    other = play_episode(balance(), task, max_steps=50, seed=evaluation_seed(1))
    assert not np.array_equal(other.states, episode.states)


@pytest.mark.parametrize("policy", [balance(), constant()], ids=["balance", "fall"])
def test_the_first_episode_of_an_evaluation_is_kept(policy):
    """Its states follow from its actions, and it ends and earns as the returns say."""
    world = SimulatedWorld(replace(get_task("cartpole"), max_steps=60))
    found = evaluate(policy, world.task, episodes=3)
    episode = found.first
    states, actions = torch.from_numpy(episode.states), torch.from_numpy(episode.actions)
    torch.testing.assert_close(states[1:], world.step(states[:-1], actions), rtol=0, atol=1e-5)
    assert episode.total_reward == pytest.approx(found.returns[0].item())
    assert len(episode.rewards) == found.lengths[0]
    assert episode.terminated == found.terminated[0]


def test_an_episode_is_drawn_as_it_was_played():
    pytest.importorskip("pygame")
    world = SimulatedWorld("pendulum-swingup")
    played = play_episode(constant(2.0), world.task, max_steps=30, render=True)
    drawn = draw_episode(replace(played, frames=np.zeros((0, 0, 0, 3), np.uint8)), world)
    assert np.array_equal(drawn.frames, played.frames)
    assert drawn.frame_steps == played.frame_steps
    few = draw_episode(played, world, frames_per_second=10.0, max_frames=4)
    assert np.array_equal(few.frames, played.frames[:8:2])


def test_states_are_as_they_are_observed():
    """A pendulum that goes round: the angle stays on the circle, the velocity is its own."""
    episode = play_episode(constant(2.0), "pendulum-swingup", max_steps=200)
    theta = episode.states[:, 0]
    assert np.abs(theta).max() <= math.pi
    assert np.abs(episode.states[:, 1]).max() > 1.0
    turned = np.unwrap(theta)
    assert np.abs(turned[-1] - turned[0]) > 0.1
    speed = np.diff(turned) / episode.task.time_step
    np.testing.assert_allclose(speed, episode.states[1:, 1], atol=1e-3)


def test_an_episode_in_a_gymnasium_world():
    """Pendulum-v1 is the pendulum without friction and with a limit, step for step."""
    task = replace(PENDULUM, velocity_limits={"theta_dot": 8.0})
    world = GymnasiumWorld(task, GymnasiumConfig("Pendulum-v1"))
    episode = play_episode(constant(1.5), task, world=world, max_steps=60)
    assert episode.states.shape == (61, 2)
    assert episode.actions.shape == (60, 1)
    assert not episode.terminated
    states, actions = torch.from_numpy(episode.states), torch.from_numpy(episode.actions)
    simulated = SimulatedWorld(task, SimulatedConfig(friction={"joint": 0.0}))
    expected = simulated.step(states[:-1], actions)
    assert task.difference(states[1:], expected).abs().max() < 1e-4
    assert states[:, 1].max() == 8.0, "the limit was met"
    rewards = task.reward(states[:-1], actions, states[1:]).numpy()
    np.testing.assert_allclose(episode.rewards, rewards, atol=1e-4)
    again = play_episode(constant(1.5), task, world=world, max_steps=60)
    assert np.array_equal(again.states, episode.states)


def test_an_episode_ends_with_the_tasks_time_in_any_world():
    task = replace(PENDULUM, max_steps=7)
    for world in (None, GymnasiumWorld(task, GymnasiumConfig("Pendulum-v1"))):
        assert len(play_episode(constant(), task, world=world).rewards) == 7
        assert len(play_episode(constant(), task, world=world, max_steps=99).rewards) == 7


# Pictures.


def test_frames_are_subsampled_and_limited():
    pytest.importorskip("pygame")
    options = {"max_steps": 25, "render": True}
    episode = play_episode(constant(), "cartpole-swingup", frames_per_second=10, **options)
    assert episode.frame_steps == 5
    assert len(episode.frames) == 6
    assert len(play_episode(constant(), "acrobot", max_frames=3, **options).frames) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="others need no name of a display")
@pytest.mark.parametrize(("display", "driver"), [(None, "dummy"), (":0", None)])
def test_pictures_need_no_display(monkeypatch, display, driver):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", "")  # so that it is as it was afterwards
    monkeypatch.delenv("SDL_VIDEODRIVER")
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    _prepare_pygame(SimulatedWorld(get_task("pendulum")))
    assert os.environ.get("SDL_VIDEODRIVER") == driver


def test_pictures_without_pygame(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pygame: .*phihp_torchrl\[rendering\]"):
        play_episode(constant(), "pendulum", render=True)
    assert len(play_episode(constant(), "pendulum", max_steps=2).rewards) == 2


def test_pictures_of_a_gymnasium_world():
    pytest.importorskip("pygame")
    world = GymnasiumWorld(PENDULUM, GymnasiumConfig("Pendulum-v1"))
    episode = play_episode(constant(2.0), PENDULUM, world=world, max_steps=12, render=True)
    assert episode.frames.shape == (13, 500, 500, 3)
    assert episode.frames.dtype == np.uint8
    assert (episode.frames[0] != episode.frames[-1]).any(), "nothing moves"


def test_a_world_that_draws_nothing_says_so():
    world = EnvWorld(PENDULUM, SimulatedWorld(PENDULUM).make_env, label="my robot")
    with pytest.raises(ValueError, match=r"render: expected a world that draws .* my robot draws"):
        play_episode(constant(), PENDULUM, world=world, render=True)
