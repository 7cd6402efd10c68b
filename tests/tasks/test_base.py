"""A task: its one step, its bounds, and fields that are checked by their names."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl import Task, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.systems import Pendulum
from phihp_torchrl.tasks import Box, Transition, list_tasks
from phihp_torchrl.worlds import SimulatedWorld

inf = math.inf
all_tasks = pytest.mark.parametrize("name", list_tasks())


def balance(**changes):
    return Task(
        **{
            "name": "balance",
            "system": Pendulum(),
            "action_high": (1.0,),
            "time_step": 0.1,
            "max_steps": 10,
            "reset": Box((0.0, 0.0), (0.0, 0.0)),
            "reward": lambda state, action, next_state: next_state[..., 0].cos(),
            **changes,
        }
    )


def test_a_task_is_one_call():
    task = balance(velocity_limits={"theta_dot": 3.0})
    assert task.layout.limits == ((-3.0, 3.0),)
    assert not task.is_terminated(task.reset.sample([2])).any()


def test_tasks_are_frozen_and_hashable():
    task = get_task("acrobot")
    with pytest.raises(AttributeError):
        task.max_steps = 1
    assert {task: 1}[get_task("acrobot")] == 1


@all_tasks
def test_what_is_above_sees_the_system_through_the_task(name):
    task = get_task(name)
    system, state, other = task.system, *task.coverage.sample([2, 8])
    assert (task.state_dim, task.action_dim) == (system.state_dim, system.action_dim)
    assert task.observation_dim == system.observation_dim
    observation = task.observe(state)
    assert torch.equal(observation, system.observe(state))
    assert torch.equal(task.locate(observation), system.locate(observation))
    assert torch.equal(task.difference(state, other), system.difference(state, other))


# A step


@all_tasks
def test_a_transition_clips_moves_rewards_and_ends(name):
    task = get_task(name)
    state = task.coverage.sample([32], dtype=torch.float64)
    action = 5 * task.bounds.scale * torch.randn(32, task.action_dim, dtype=torch.float64)
    asked = []

    def step(state, action):
        asked.append(action)
        return state + 0.1

    found = task.transition(step, state, action)
    assert isinstance(found, Transition)
    assert len(asked) == 1
    held = task.bounds.clip(action)
    assert torch.equal(asked[0], held)
    assert torch.equal(found.next_state, state + 0.1)
    assert torch.equal(found.reward, task.reward(state, held, state + 0.1))
    assert torch.equal(found.terminated, task.is_terminated(state + 0.1))


@all_tasks
def test_actions_are_clipped_to_their_bounds(name):
    task, world = get_task(name), SimulatedWorld(name)
    state = task.coverage.sample([16])
    high = torch.tensor(task.action_high).expand(16, -1)
    assert torch.equal(world.step(state, 100 * high), world.step(state, high))
    assert torch.equal(world.step(state, -100 * high), world.step(state, -high))
    assert not torch.equal(world.step(state, high), world.step(state, 0.5 * high))


# Bounds that are not symmetric


ASYMMETRIC = [((-6.0,), (12.0,)), ((0.0,), (100.0,)), ((-3.0,), (-1.0,)), ((0.1,), (0.7,))]


@pytest.mark.parametrize(("low", "high"), ASYMMETRIC)
def test_asymmetric_bounds_hold_in_a_transition(low, high):
    task = balance(action_low=low, action_high=high)
    assert (task.action_low, task.action_high) == (low, high)
    assert task.bounds.low.tolist() == pytest.approx([*low])
    assert task.bounds.high.tolist() == pytest.approx([*high])
    action = torch.tensor([[-1e3], [low[0]], [sum(low + high) / 2], [high[0]], [1e3]])
    expected = torch.tensor([[low[0]], [low[0]], [sum(low + high) / 2], [high[0]], [high[0]]])
    assert torch.equal(task.clip_action(action), expected)
    asked = []
    task.transition(lambda s, a: (asked.append(a), s)[1], torch.zeros(5, 2), action)
    assert torch.equal(asked[0], expected)
    world = SimulatedWorld(task)
    state = task.reset.sample([5])
    assert torch.equal(world.step(state, action), world.step(state, expected))


@given(st.floats(-1e3, 1e3), st.floats(1e-2, 1e3), st.integers(0, 99))
def test_the_task_clips_as_its_bounds_do(low, width, seed):
    task = balance(action_low=(low,), action_high=(low + width,))
    generator = torch.Generator().manual_seed(seed)
    action = low + 2 * width * torch.randn(50, 1, generator=generator)
    assert torch.equal(task.clip_action(action), task.bounds.clip(action))


def test_the_lower_bound_is_by_default_the_upper_ones_negative():
    assert balance(action_high=(3,)).action_low == (-3.0,)
    assert balance(action_high=(3,), action_low=(0,)).action_low == (0.0,)
    task = get_task("acrobot-swingup")
    assert replace(task, action_high=(1.0, 4.0), action_low=None).action_low == (-1.0, -4.0)


# Velocity limits


@pytest.mark.parametrize(
    ("limit", "kept"), [(3.0, (-3.0, 3.0)), ((-1.0, 8.0), (-1.0, 8.0)), ((0.0, inf), (0.0, inf))]
)
def test_velocity_limits_may_be_asymmetric(limit, kept):
    task = balance(velocity_limits={"theta_dot": limit}, action_high=(100.0,))
    assert task.layout.limits == (kept,)
    state = torch.tensor([[0.0, 0.5], [0.0, 0.5]])
    new = SimulatedWorld(task).step(state, torch.tensor([[100.0], [-100.0]]))
    if kept[1] < inf:
        assert new[0, 1] == kept[1]
    else:
        assert new[0, 1] > 30
    assert new[1, 1] == kept[0]


@pytest.mark.parametrize("limit", [0.0, -1.0, (1.0, 0.0), (2.0, 2.0)])
def test_velocity_limits_must_be_in_order(limit):
    with pytest.raises(ConfigError, match=r"^limits: expected low < high"):
        replace(get_task("pendulum"), velocity_limits={"theta_dot": limit})


# Bad input names the field.


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("action_high", ()),
        ("action_high", (1.0, 1.0)),
        ("action_high", (math.nan,)),
        ("action_high", (inf,)),
        ("action_low", ()),
        ("action_low", (-1.0, -1.0)),
        ("action_low", (math.nan,)),
        ("action_low", (-inf,)),
        ("action_low", (2.0,)),
        ("action_low", (3.0,)),
        ("time_step", 0.0),
        ("time_step", -0.1),
        ("time_step", math.nan),
        ("time_step", inf),
        ("max_steps", 0),
        ("max_steps", -5),
        ("max_steps", 2.5),
        ("reset", Box((0.0,), (1.0,))),
        ("coverage", Box((0.0,) * 3, (1.0,) * 3)),
        ("goal", Box((), ())),
        ("velocity_limits", {"speed": 1.0}),
    ],
)
def test_task_validation_names_the_field(field, value):
    with pytest.raises(ConfigError, match=rf"^{field}(\[0\])?: "):
        replace(get_task("pendulum"), **{field: value})


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_an_upper_bound_alone_must_be_positive(value):
    with pytest.raises(ConfigError, match=r"^action_high: expected positive bounds where action_l"):
        balance(action_high=(value,))
    assert balance(action_high=(value,), action_low=(-2.0,)).action_high == (value,)
