"""GIFs and figures of an episode."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from lopsided import LOPSIDED
from PIL import Image

from phihp_torchrl import Agent, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.evaluation import (
    episode_figure,
    evaluation_seed,
    play_episode,
    show_episode,
    write_gif,
)
from phihp_torchrl.worlds import (
    EnvWorld,
    GymnasiumConfig,
    GymnasiumWorld,
    SimulatedConfig,
    SimulatedWorld,
)

from .policies import constant, planner

SHORT = replace(get_task("pendulum-swingup"), max_steps=20)


@pytest.fixture(scope="module")
def rendered():
    pytest.importorskip("pygame")
    return play_episode(constant(2.0), "pendulum-swingup", max_steps=30, render=True)


def test_gif(rendered, tmp_path):
    assert rendered.frames.shape[0] == 31
    path = write_gif(rendered, tmp_path / "new" / "episode.gif", size=96)
    assert path.stat().st_size < 1_000_000
    assert [p.name for p in path.parent.iterdir()] == ["episode.gif"]
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.size == (96, 96)
        assert image.n_frames > 10
        assert image.info["duration"] == 50
        pictures = []
        for i in (0, image.n_frames - 1):
            image.seek(i)
            pictures.append(np.asarray(image.convert("RGB"), dtype=float))
    assert all(picture.std() > 5 for picture in pictures), "blank"
    assert np.abs(pictures[0] - pictures[1]).max() > 50, "nothing moves"


def test_gif_keeps_within_its_size(rendered, tmp_path):
    large = write_gif(rendered, tmp_path / "large.gif").stat().st_size
    small = write_gif(rendered, tmp_path / "small.gif", max_bytes=large // 3).stat().st_size
    assert small <= large // 3
    with pytest.raises(ValueError, match="max_bytes: expected at least"):
        write_gif(rendered, tmp_path / "no.gif", max_bytes=10)
    with pytest.raises(ValueError, match="size: expected"):
        write_gif(rendered, tmp_path / "no.gif", size=1)
    with pytest.raises(ValueError, match="episode: expected pictures"):
        write_gif(play_episode(constant(), "pendulum", max_steps=2), tmp_path / "no.gif")
    assert not (tmp_path / "no.gif").exists()


@pytest.mark.parametrize("name", ["pendulum", "acrobot-swingup"])
def test_episode_figure(name, tmp_path):
    task = get_task(name)
    episode = play_episode(constant(1.0, task.action_dim), task, max_steps=40)
    figure = episode_figure(episode)
    assert len(figure.axes) == task.state_dim + task.action_dim + 1
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == [*task.system.state_names, *task.system.action_names, "reward"]
    velocity = labels.index(task.system.state_names[-1])
    drawn = figure.axes[velocity].lines[0].get_ydata()
    np.testing.assert_array_equal(drawn, episode.states[:, -1])
    angle = figure.axes[0].lines[0].get_ydata()
    assert np.nanmax(np.abs(angle)) <= math.pi
    figure.savefig(tmp_path / "episode.png")
    assert np.asarray(Image.open(tmp_path / "episode.png").convert("L")).std() > 5


def test_actions_are_drawn_within_lopsided_bounds():
    figure = episode_figure(play_episode(constant(1.0), LOPSIDED, max_steps=5))
    labels = [axis.get_ylabel() for axis in figure.axes]
    low, high = figure.axes[labels.index("torque")].get_ylim()
    assert (low, high) == (pytest.approx(-6.9), pytest.approx(12.9))


# Both at once.


@pytest.mark.usefixtures("drawn")
def test_an_agent_is_shown(tmp_path):
    pytest.importorskip("pygame")
    agent = planner(SHORT)
    files = show_episode(agent, tmp_path / "new", name="swing")
    assert [file.name for file in files] == ["swing.png", "swing.gif"]
    assert all(file.stat().st_size > 1000 for file in files)
    assert [f.name for f in show_episode(agent, tmp_path, video=False)] == ["episode.png"]
    assert not (tmp_path / "episode.gif").exists()


def test_an_agent_is_shown_in_its_world_with_its_seed(tmp_path, monkeypatch):
    asked = []

    def spy(agent, task, **options):
        asked.append(options)
        return play_episode(agent, task, max_steps=3, **options)

    monkeypatch.setattr("phihp_torchrl.evaluation.show.play_episode", spy)
    agent = planner(SHORT)
    world = SimulatedWorld(agent.task, SimulatedConfig(integrator="rk4"))
    show_episode(agent, tmp_path, world=world, video=False, seed=3)
    assert asked == [{"seed": evaluation_seed(3), "world": world}]


def test_where_nothing_is_drawn_a_figure_is_left_and_a_warning(tmp_path, caplog):
    agent = planner(SHORT)
    world = EnvWorld(agent.task, SimulatedWorld(agent.task).make_env, label="my robot")
    with caplog.at_level(logging.WARNING, logger="phihp_torchrl"):
        files = show_episode(agent, tmp_path, world=world)
    assert [file.name for file in files] == ["episode.png"]
    assert {path.name for path in tmp_path.iterdir()} == {"episode.png", "episode.csv"}
    assert "No GIF of the episode: render: expected a world that draws" in caplog.text


def test_a_world_that_cannot_draw_is_told_and_ends_nothing(tmp_path, caplog, monkeypatch):
    task = replace(get_task("pendulum"), max_steps=3)
    world = GymnasiumWorld(task, GymnasiumConfig("Pendulum-v1"))
    drawn = "gymnasium.envs.classic_control.pendulum.PendulumEnv.render"
    missing = gymnasium.error.DependencyNotInstalled("pygame is not installed")

    def render(self):
        raise missing

    monkeypatch.setattr(drawn, render)
    files = show_episode(Agent(task, actor=Actor(task)), tmp_path, world=world)
    assert [file.name for file in files] == ["episode.png"]
    assert "pygame is not installed" in caplog.text
