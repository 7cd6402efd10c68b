"""Violations of constraints in episodes that are made by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Constraint, evaluate, get_task
from phihp_torchrl.evaluation import controllers_table
from phihp_torchrl.tasks import Box
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld

from .policies import constant

FORCE = Constraint("force", high=3.0, price=0.0, function=lambda s, action: action[..., 0])


def coasting(steps=10, **changes):
    """A cart at 2 m/s, whose pole is upright: 0.04 m a step, from 0."""
    start = Box((0.0, 2.0, 0.0, 0.0), (0.0, 2.0, 0.0, 0.0))
    return replace(get_task("cartpole-swingup"), reset=start, max_steps=steps, **changes)


def ways(task):
    return {
        "model": {},
        "batch": {"env": SimulatedWorld(task).make_batch([2])},
        "one": {"world": EnvWorld(task, SimulatedWorld(task).make_env)},
    }


@pytest.mark.parametrize("way", ["model", "batch", "one"])
def test_violations_are_counted_and_measured_in_each_way(way):
    """After steps 8, 9 and 10 the cart is beyond 0.3 m: at 0.32, 0.36 and 0.40 m, or nearly."""
    near = Constraint("x", low=-1.0, high=0.3, price=5.0)
    task = coasting(constraints=(near, FORCE))
    result = evaluate(constant(0.0), task, episodes=2, **ways(task)[way])
    assert result.violations["x"].steps.tolist() == [3, 3]
    assert result.violations["x"].largest.tolist() == pytest.approx([0.1, 0.1], abs=0.01)
    summary = result.summary()
    assert summary["violations/x/steps_share"] == pytest.approx(0.3)
    assert summary["violations/x/episodes_share"] == 1.0
    assert summary["violations/x/largest"] == pytest.approx(0.1, abs=0.01)
    assert summary["violations/force/largest"] == 0.0
    free = evaluate(constant(0.0), coasting(), episodes=2)
    torch.testing.assert_close(result.returns, free.returns, rtol=1e-4, atol=1e-4)  # no price


@pytest.mark.parametrize("way", ["model", "batch", "one"])
def test_a_violation_that_ends_an_episode_is_its_last(way):
    task = coasting(constraints=(Constraint("x", high=0.3, hard=True), FORCE))
    result = evaluate(constant(5.0), task, episodes=2, **ways(task)[way])
    assert result.terminated.all()
    assert (result.lengths < 9).all()
    assert result.violations["x"].steps.tolist() == [1, 1]
    assert result.violations["force"].steps.tolist() == result.lengths.tolist()
    assert result.violations["force"].largest.tolist() == [2.0, 2.0]


def test_the_command_is_the_one_that_the_rate_allows():
    task = coasting(constraints=(FORCE,), action_rate_limit=50.0)  # 1 N a step
    for options in ({}, {"env": SimulatedWorld(task).make_env()}):
        result = evaluate(constant(10.0), task, episodes=1, **options)
        assert result.violations["force"].steps.tolist() == [7]
        assert result.violations["force"].largest.tolist() == pytest.approx([7.0], abs=1e-4)


def test_the_constraints_are_those_of_the_task_that_is_evaluated():
    """Whoever reports on a world of a task without constraints brings his own."""
    task = coasting(constraints=(FORCE,))
    result = evaluate(constant(5.0), task, episodes=1, world=SimulatedWorld(coasting()))
    assert result.violations["force"].steps.tolist() == [10]


def test_without_constraints_nothing_is_reported():
    result = evaluate(constant(), coasting(), episodes=2)
    assert result.violations is None
    assert not any(key.startswith("violations") for key in result.summary())


def test_the_table_shows_them_for_every_controller():
    found = {"violations/x/steps_share": 0.25, "violations/x/largest": 0.5, "chatter": 0.1}
    lines = controllers_table("cart", {"a": {"returns": [1.0], **found}, "b": {"returns": [2.0]}})
    lines = lines.splitlines()
    assert lines[0] == "| cart | return | s.e. | chatter | x: steps share | x: largest |"
    assert lines[2] == "| a | 1.0 | 0.0 | 0.100 | 0.250 | 0.500 |"
    assert lines[3] == "| b | 2.0 | 0.0 | – | – | – |"
