"""The regulator on a reference that stands still: where it acts, and from which action."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.baselines import LQI, Settle
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Actuator, Task

from .parts import Tank, TwoTanks, following, prior_of


def at(task: Task, level: float, reference: float, size: int = 1) -> Tensor:
    """A state at a level, all of whose known reference is constant."""
    physical = torch.full((1, size), level)
    signals = torch.full((1, task.outside.size), reference)
    return task.with_signals(task.at_rest(physical), signals)


@pytest.fixture
def task() -> Task:
    return following(Tank())


@pytest.fixture
def settle(task) -> Settle:
    return Settle.from_model(task, prior_of(task))


def near(settle, *arguments) -> bool:
    return settle.take(*arguments)[0].item()


def test_it_takes_over_within_a_tenth_and_goes_on_three_times_as_far(task, settle):
    """The half-range is 2."""
    assert not near(settle, at(task, 1.21, 1.0))
    assert near(settle, at(task, 1.19, 1.0))
    assert near(settle, at(task, 1.59, 1.0))
    assert not near(settle, at(task, 1.61, 1.0))
    assert not near(settle, at(task, 1.59, 1.0)), "it has left"


def test_it_waits_for_plans_that_do_not_come_near_and_then_acts_from_farther_away(task, settle):
    close = settle.closer(0.1)
    wait = int(close.wait.item())
    assert wait == int(5 * LQI.from_model(task, prior_of(task)).times[0] / task.time_step)
    acts = [near(close, at(task, 1.1, 1.0)) for _ in range(wait + 3)]
    assert acts == [False] * (wait + 1) + [True] * 2
    assert near(close, at(task, 1.15, 1.0)), "it goes on"
    assert not near(close, at(task, 1.25, 1.0))
    assert not near(close, at(task, 1.1, 0.95)), "the reference has moved"
    assert not near(close, at(task, 1.1, 0.95))


def test_it_leaves_a_reference_that_moves(task, settle):
    assert near(settle, at(task, 1.0, 1.0))
    assert not near(settle, at(task, 1.0, 1.01))
    assert near(settle, at(task, 1.0, 1.01)), "which stands still again"


def test_it_waits_for_what_is_ahead():
    task = following(Tank(), preview=3)
    settle = Settle.from_model(task, prior_of(task))
    ahead = torch.tensor([[1.0, 1.0, 1.0, 1.5]])
    assert not near(settle, task.with_signals(at(task, 1.0, 1.0), ahead))
    assert near(settle, at(task, 1.0, 1.0))


def test_an_episode_starts_anew(task, settle):
    assert near(settle, at(task, 1.5, 1.5))
    assert not near(settle, at(task, 1.9, 1.5), torch.tensor([True])), "not three times as far"
    assert near(settle, at(task, 1.5, 1.0 + 0.5), torch.tensor([True]))
    settle.reset()
    assert near(settle, at(task, 0.5, 0.5)), "another reference, but no step before it"


def test_its_first_action_is_the_last_that_was_sent(task, settle):
    """So it takes over without a jump, with what a load asks for in its integral."""
    settle.take(at(task, 2.0, 1.0))
    sent = torch.tensor([[0.73]])
    settle.follow(sent)
    is_near, action = settle.take(at(task, 1.1, 1.0))
    assert is_near
    assert torch.allclose(action, sent, atol=1e-5)


def test_it_is_the_lqi_from_the_start_of_an_episode(task, settle):
    lqi = LQI.from_model(task, prior_of(task))
    for k in range(4):
        state = at(task, 1.0 + 0.02 * k, 1.0)
        starts = torch.tensor([k == 0])
        is_near, action = settle.take(state, starts)
        settle.follow(action)
        assert is_near
        assert torch.allclose(action, task.clip_action(lqi.act(state, starts)), atol=1e-4)


@pytest.mark.parametrize("system", [Tank(), TwoTanks()])
def test_it_is_built_again_from_its_config_and_buffers(system):
    task = replace(following(system), actuator=Actuator(delay_steps=1.0))
    made = Settle.from_model(task, prior_of(task))
    again = Settle.from_config(task, made.config)
    again.load_state_dict(made.state_dict())
    state = at(task, 1.0, 1.05, system.state_dim)
    for ours, theirs in zip(again.take(state), made.take(state), strict=True):
        assert torch.equal(ours, theirs)


def test_closer_reaches_a_share(settle):
    assert torch.allclose(settle.closer(0.1).reach, 0.1 * settle.reach)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rows": []}, "rows: expected 1 numbers"),
        ({"rows": [10**9]}, "rows: expected 2 to 1000"),
        ({"rows": "17"}, "rows: expected 1 numbers"),
        ({"moved": [5]}, "moved: expected places below"),
    ],
)
def test_a_config_of_another_task_is_refused(task, settle, changes, words):
    with pytest.raises(ConfigError, match=words):
        Settle.from_config(task, settle.config | changes)


def test_a_task_without_a_reference_has_none():
    task = get_task("pendulum")
    with pytest.raises(ConfigError, match="reference: expected one of components"):
        Settle.from_model(task, HybridDynamics.pure_prior(task))
