"""The regulator that takes over near the goal: where it acts, and what it is made of."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.baselines import Catch
from phihp_torchrl.baselines.catch import find_catch
from phihp_torchrl.baselines.point import linearise
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Actuator, Box


def prior(name):
    task = get_task(name)
    return task, HybridDynamics.pure_prior(task)


def test_it_is_the_regulator_below_its_level_and_leaves_the_rest():
    task, dynamics = prior("pendulum-swingup")
    lqr, level = find_catch(task, dynamics)
    catch = Catch.from_model(task, dynamics)
    state = task.coverage.sample([200], generator=torch.Generator().manual_seed(0))
    state = torch.cat([state, 0.01 * state])
    near = lqr.value(state) < level
    assert 200 <= near.sum() < 400
    assert torch.equal(catch.near(state), near)
    other = torch.full((400, 1), 1.5)
    expected = torch.where(near[:, None], task.clip_action(lqr.act(state)), other)
    assert torch.allclose(catch(state, other), expected, atol=1e-5)


def test_closer_is_a_share_of_the_level():
    task, dynamics = prior("pendulum-swingup")
    catch = Catch.from_model(task, dynamics)
    closer = catch.closer(0.1)
    assert closer.level.item() == pytest.approx(0.1 * catch.level.item())
    assert torch.equal(closer.gain, catch.gain)
    again = Catch.from_model(task, dynamics, share=0.1)
    assert again.level.item() == pytest.approx(closer.level.item())


def test_it_is_built_again_from_its_config_and_buffers():
    task = replace(get_task("pendulum-swingup"), actuator=Actuator(delay_steps=2.0))
    catch = Catch.from_model(task, HybridDynamics.pure_prior(task))
    assert len(catch.moved) == 2  # commands under way
    again = Catch.from_config(task, catch.config)
    again.load_state_dict(catch.state_dict())
    state = task.sample_start([20])
    assert torch.equal(again(state, torch.ones(20, 1)), catch(state, torch.ones(20, 1)))


@pytest.mark.parametrize("moved", [[3], "all", None])
def test_a_config_of_another_task_is_refused(moved):
    task = get_task("pendulum")
    with pytest.raises(ConfigError, match="moved: expected"):
        Catch.from_config(task, {"kind": "goal", "moved": moved})


def test_no_goal_no_catch():
    task, dynamics = prior("acrobot")  # every step costs 1 until it ends, at a height
    with pytest.raises(ConfigError, match="goal"):
        Catch.from_model(task, dynamics)


def test_a_rest_is_found_where_the_middle_of_the_box_is_none():
    """Hanging is in the middle, and upright earns most."""
    swing = get_task("acrobot-swingup")
    box = Box.around((0.0,) * 4, swing.coverage.high)

    def high(state, action, next_state):
        tip = -state[..., 0].cos() - (state[..., 0] + state[..., 1]).cos()
        return torch.exp(tip - 2.0)

    task = replace(swing, goal=None, coverage=box, reset=box, reward=high, terminated=None)
    point = linearise(task, HybridDynamics.pure_prior(task))
    assert point.state[0].cos() == pytest.approx(-1.0, abs=0.01)
    assert point.state[1].cos() == pytest.approx(1.0, abs=0.01)
    assert point.state[2:].abs().max() < 1e-6


def test_no_rest_is_sought_among_states_that_end_the_episode():
    task = replace(
        get_task("acrobot-swingup"),
        goal=None,
        coverage=Box.around((0.0,) * 4, (1.0,) * 4),
        reset=Box.around((0.0,) * 4, (1.0,) * 4),
        reward=lambda state, action, next_state: state[..., 0],
        terminated=lambda next_state: next_state[..., 0] > -2.0,
    )
    with pytest.raises(ConfigError, match="goal: expected a state to stay in"):
        linearise(task, HybridDynamics.pure_prior(task))
