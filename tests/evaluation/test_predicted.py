"""A model's predictions beside an episode."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phihp_torchrl import Agent, HybridDynamics, get_task
from phihp_torchrl.evaluation import episode_figure, play_episode, predict_episode, show_episode
from phihp_torchrl.worlds import SimulatedWorld

from .policies import constant

TASK = replace(get_task("pendulum-swingup"), max_steps=30)


def test_an_exact_model_predicts_an_episode_and_a_wrong_one_is_wrong_until_it_begins_anew() -> None:
    episode = play_episode(constant(2.0), TASK)
    exact = predict_episode(SimulatedWorld(TASK).oracle(), episode, every=10)
    np.testing.assert_allclose(exact.states, episode.states[1:], atol=2e-3)
    wrong = predict_episode(HybridDynamics.pure_prior(TASK, constants={"mass": 2.0}), episode, 10)
    error = np.abs(wrong.states - episode.states[1:])[:, 1]
    assert error[9] > 3 * error[0] > 0
    assert error[10] < error[9]


def test_pieces_begin_at_the_episode() -> None:
    episode = play_episode(constant(2.0), TASK)
    found = predict_episode(SimulatedWorld(TASK).oracle(), episode, every=20)
    pieces = list(found.pieces(episode, 1))
    assert [(at.start, at.stop, len(values)) for at, values in pieces] == [
        (0, 21, 21),
        (20, 31, 11),
    ]
    assert pieces[1][1][0] == episode.states[20, 1]


def test_the_figure_shows_model_and_returns() -> None:
    episode = play_episode(constant(2.0), TASK)
    predicted = predict_episode(SimulatedWorld(TASK).oracle(), episode)
    curve = {"while learning": [(100, -900.0), (200, -500.0)], "the agent": [(200, -400.0)]}
    figure = episode_figure(episode, predicted, curve)
    assert [panel.get_ylabel() for panel in figure.axes][-1] == "return"
    assert figure.axes[-1].get_xlabel() == "real steps"
    assert len(figure.axes[1].lines) == 3  # the episode, and two predictions
    assert len(episode_figure(episode).axes[1].lines) == 1


def test_the_table_of_an_episode_has_what_happened_and_what_was_foreseen(tmp_path: Path) -> None:
    agent = Agent(TASK, actor=constant(2.0), dynamics=SimulatedWorld(TASK).oracle())
    show_episode(agent, tmp_path, video=False)
    with (tmp_path / "episode.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 31
    assert rows[0]["predicted theta"] == ""
    assert float(rows[5]["predicted theta"]) == pytest.approx(float(rows[5]["theta"]), abs=1e-3)
    assert {row["torque"] for row in rows} == {"2", ""}
