"""The last action as state: the limit of its rate, the price of its change, beside an actuator."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Actuator, list_tasks

RATES = {"action_rate_limit": 10.0, "action_rate_cost": 0.3}
"""For the pendulum: 0.5 of its 2 Nm in a step."""


def stay(state, action):
    return state


def rated(name="pendulum", **changes):
    return replace(get_task(name), **{**RATES, **changes})


@pytest.mark.parametrize("name", list_tasks())
def test_a_task_without_additions_has_no_register(name):
    task = get_task(name)
    assert task.register_count == 0
    assert task.price(torch.zeros(3, task.state_dim), torch.ones(3, task.action_dim)) is None
    assert task.unpriced() is task


@settings(max_examples=25)
@given(st.lists(st.floats(-9.0, 9.0), min_size=1, max_size=20))
def test_commands_are_the_nearest_within_bounds_and_rate(wanted):
    task, last = rated(), torch.zeros(1, dtype=torch.float64)
    for value in wanted:
        command = task.command(last, torch.tensor([value], dtype=torch.float64))
        low, high = max(-2.0, last.item() - 0.5), min(2.0, last.item() + 0.5)
        assert command.item() == pytest.approx(min(max(value, low), high), abs=1e-12)
        assert task.command(last, command).equal(command)
        last = task.acting(last, command)[1]
        assert last.equal(command)


def test_a_transition_moves_and_earns_by_the_command_less_its_price():
    seen = []
    task, plain = rated(), get_task("pendulum")
    state = torch.tensor([[0.5, 0.0, 1.0], [0.5, 0.0, -2.0]])
    found = task.transition(lambda s, a: (seen.append(a), s)[1], state, torch.full((2, 1), 9.0))
    command = torch.tensor([[1.5], [-1.5]])
    assert seen[0].equal(command)
    assert found.next_state.equal(torch.cat([state[:, :2], command], -1))
    earned = plain.transition(stay, state[:, :2], command).reward
    price = 0.3 * torch.full((2,), 0.25**2)  # 0.5 Nm of a half-range of 2 Nm
    torch.testing.assert_close(found.reward, earned - price)
    torch.testing.assert_close(task.price(state, torch.full((2, 1), 9.0)), price)
    world = task.unpriced()
    assert world.state_dim == task.state_dim
    torch.testing.assert_close(world.transition(stay, state, command).reward, earned)


def test_the_price_is_in_half_ranges_and_adds_up_over_actions():
    task = replace(
        get_task("acrobot-swingup"),
        action_low=(0.0, -1.0),
        action_high=(10.0, 3.0),
        action_rate_cost=2.0,
    )
    state = task.at_rest(torch.zeros(task.system.state_dim))
    assert task.split(state)[1].tolist() == [0.0, 0.0]
    price = task.price(state, torch.tensor([5.0, 3.0]))
    assert price.item() == pytest.approx(2.0 * (1.0 + 1.5**2))


def test_each_action_has_its_own_rate():
    task = replace(get_task("acrobot-swingup"), action_rate_limit=[1.0, 100.0])
    command = task.command(torch.zeros(2), torch.tensor([9.0, 9.0]))
    expected = [1.0 * task.time_step, min(100.0 * task.time_step, task.action_high[1])]
    assert command.tolist() == pytest.approx(expected)


def test_an_episode_starts_with_the_command_nearest_to_zero():
    task = rated(action_low=(0.5,), action_high=(2.0,))
    assert task.sample_start([4])[:, -1].tolist() == [0.5] * 4


ACTUATORS = [
    Actuator(delay_steps=2.0),
    Actuator(delay_steps=1.5, lag=0.02, slew=40.0, dead_zone=0.2, gain_low=0.5),
]


@pytest.mark.parametrize("actuator", ACTUATORS, ids=str)
def test_an_actuator_gets_the_limited_command(actuator):
    task, late = rated(actuator=actuator), replace(get_task("pendulum"), actuator=actuator)
    state, other = task.at_rest(torch.tensor([0.3, 0.0])), late.at_rest(torch.tensor([0.3, 0.0]))
    commands, last = [], torch.zeros(1)
    for value in (2.0, 2.0, -2.0, 0.0, 1.0):
        commands.append(last := last + (value - last).clamp(-0.5, 0.5))
        state = task.transition(lambda s, a: s + a, state, torch.tensor([value])).next_state
        other = late.transition(lambda s, a: s + a, other, last).next_state
        torch.testing.assert_close(state[:-1], other)
        assert state[-1:].equal(last)
    registers = task.registers.along(torch.stack(commands), task.time_step, torch.zeros(1))[1]
    torch.testing.assert_close(registers[-1], task.acting(registers[-2], commands[-2])[1])


@pytest.mark.parametrize("actuator", [None, *ACTUATORS], ids=str)
def test_a_batch_is_its_rows_and_observations_lead_back(actuator):
    task = rated("cartpole", actuator=actuator)
    generator = torch.Generator().manual_seed(0)
    registers = task.random_registers([2, 3], generator)
    state = torch.cat([task.reset.sample([2, 3]), registers], -1)
    torch.testing.assert_close(task.locate(task.observe(state)), state)
    assert (task.observe(state)[..., -1].abs() <= 1.0).all()
    action = 20.0 * torch.randn(2, 3, 1, generator=generator)
    whole = task.transition(lambda s, a: s + a, state, action)
    row = task.transition(lambda s, a: s + a, state[1, 2], action[1, 2])
    for one, other in zip(row, whole, strict=True):
        torch.testing.assert_close(one, other[1, 2])


def test_random_registers_agree_with_each_other():
    task = rated(actuator=Actuator(delay_steps=2.0))
    registers = task.random_registers([100])
    assert registers.shape == (100, 3)
    assert registers[:, 1].equal(registers[:, 2])  # the newest that waits is the last command
    assert registers.std() > 0.5


@pytest.mark.parametrize(
    ("numbers", "key"),
    [
        ({"action_rate_limit": 0.0}, "action_rate_limit"),
        ({"action_rate_limit": (1.0, 2.0)}, "action_rate_limit"),
        ({"action_rate_limit": "fast"}, "action_rate_limit"),
        ({"action_rate_cost": -1.0}, "action_rate_cost"),
        ({"action_rate_cost": float("nan")}, "action_rate_cost"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(numbers, key):
    with pytest.raises(ConfigError) as error:
        replace(get_task("pendulum"), **numbers)
    assert error.value.key == key
