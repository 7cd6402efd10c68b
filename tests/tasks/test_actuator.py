"""The path of a command: dead time, lag, slew, dead zone, gains, and the registers of a task."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.tasks import Actuator

TIME_STEP = 0.04
ACTUATORS = [
    Actuator(),
    Actuator(delay_steps=2.0),
    Actuator(delay_steps=0.3),
    Actuator(lag=0.1),
    Actuator(slew=3.0),
    Actuator(delay_steps=1.5, lag=0.02, slew=40.0, dead_zone=0.2, gain_low=0.5),
    Actuator(delay_steps=(0.0, 1.25), lag=(0.1, 0.0)),
]


def respond(actuator: Actuator, commands: list[list[float]]) -> torch.Tensor:
    return actuator.along(torch.tensor(commands, dtype=torch.float64), TIME_STEP)[0]


def test_whole_delays_shift_the_commands():
    commands = [[float(i)] for i in range(1, 7)]
    assert respond(Actuator(delay_steps=2.0), commands).flatten().tolist() == [0, 0, 1, 2, 3, 4]


def test_a_fraction_of_a_delay_mixes_two_commands():
    acting = respond(Actuator(delay_steps=1.25), [[1.0], [2.0], [3.0]]).flatten()
    torch.testing.assert_close(acting, torch.tensor([0.0, 0.75, 1.75], dtype=torch.float64))


@given(st.floats(0.005, 1.0), st.floats(0.001, 0.2))
def test_the_lag_is_that_of_a_fine_simulation(constant, time_step):
    lagging = Actuator(lag=constant)
    value, fine = torch.zeros(1, dtype=torch.float64), 2000
    acting, after = lagging.step(value, torch.ones(1, dtype=torch.float64), time_step)
    times = (torch.arange(fine, dtype=torch.float64) + 0.5) * time_step / fine
    assert acting.item() == pytest.approx((1 - (-times / constant).exp()).mean().item(), abs=1e-5)
    assert after.item() == pytest.approx(1 - math.exp(-time_step / constant), abs=1e-12)


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=20), st.floats(0.5, 50.0))
def test_a_slewing_value_is_never_faster_than_its_rate(commands, rate):
    _, registers = Actuator(slew=rate).along(
        torch.tensor(commands, dtype=torch.float64).unsqueeze(-1), TIME_STEP
    )
    assert (registers.diff(dim=0).abs() <= rate * TIME_STEP * (1 + 1e-9)).all()


def test_a_dead_zone_takes_small_commands_and_a_gain_those_below_zero():
    acting = respond(Actuator(dead_zone=0.5, gain_low=0.5), [[0.4], [1.5], [-0.4], [-1.5]])
    assert acting.flatten().tolist() == [0.0, 1.0, 0.0, -0.5]


@pytest.mark.parametrize("actuator", ACTUATORS, ids=str)
def test_a_command_that_is_held_acts_in_the_end_and_rests(actuator):
    command = torch.tensor([1.5, -1.5], dtype=torch.float64)
    registers = actuator.rest(torch.zeros_like(command))
    for _ in range(200):
        acting, registers = actuator.step(registers, command, TIME_STEP)
    torch.testing.assert_close(registers, actuator.rest(command), rtol=0, atol=1e-9)
    assert acting.sign().tolist() == [1.0, -1.0]
    torch.testing.assert_close(actuator.step(actuator.rest(command), command, 1.0)[0], acting)


@pytest.mark.parametrize("actuator", ACTUATORS, ids=str)
def test_a_batch_is_its_rows(actuator):
    generator = torch.Generator().manual_seed(0)
    commands = torch.randn(5, 2, generator=generator)
    size = [5, actuator.places(2), 2]
    registers = actuator.random(torch.randn(size, generator=generator))
    whole = actuator.step(registers, commands, TIME_STEP)
    for i in range(5):
        row = actuator.step(registers[i], commands[i], TIME_STEP)
        torch.testing.assert_close(row, tuple(part[i] for part in whole))
    assert registers.shape[-1] == actuator.registers(2)


@pytest.mark.parametrize(
    ("numbers", "key"),
    [
        ({"lag": -0.1}, "lag"),
        ({"delay_steps": math.inf}, "delay_steps"),
        ({"slew": 0.0}, "slew"),
        ({"gain_low": 0.0}, "gain_low"),
        ({"dead_zone": "wide"}, "dead_zone"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(numbers, key):
    with pytest.raises(ConfigError) as error:
        Actuator(**numbers)
    assert error.value.key == key


def test_numbers_for_another_count_of_actions_are_refused():
    with pytest.raises(ConfigError, match=r"actuator.lag: .*torque"):
        replace(get_task("pendulum"), actuator=Actuator(lag=(0.1, 0.2)))


@pytest.mark.parametrize("actuator", [ACTUATORS[1], ACTUATORS[5]], ids=str)
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4", "dopri5"])
def test_a_task_moves_by_what_acts_with_any_integrator(actuator, integrator):
    plain = get_task("pendulum")
    task = replace(plain, actuator=actuator)
    solver = make_integrator(integrator)

    def step(state, action):
        torque = action[..., 0]
        return solver(
            lambda s: torch.stack([s[..., 1], torque - s[..., 0].sin()], -1),
            state,
            task.time_step,
            task.layout,
        )

    commands = torch.tensor([[1.0], [5.0], [-2.0], [0.5], [0.0]])
    acting, _ = actuator.along(plain.clip_action(commands), task.time_step)
    expected = torch.tensor([0.3, 0.0])
    state = task.at_rest(expected)
    for command, action in zip(commands, acting, strict=True):
        moved = task.transition(step, state, command)
        before, expected = expected, step(expected, action)
        state = moved.next_state
        torch.testing.assert_close(task.split(state)[0], expected)
        # The reward is that of the command, and of the physical states.
        torch.testing.assert_close(
            moved.reward, plain.reward(before, plain.clip_action(command), expected)
        )


@pytest.mark.parametrize("actuator", ACTUATORS[:-1], ids=str)
def test_observations_have_the_registers_in_half_ranges_and_lead_back(actuator):
    task = replace(get_task("cartpole"), actuator=actuator)
    registers = actuator.random(10.0 * torch.ones(3, actuator.places(1), 1))
    state = torch.cat([task.reset.sample([3]), registers], -1)
    observation = task.observe(state)
    assert observation.shape == (3, task.observation_dim)
    torch.testing.assert_close(task.locate(observation), state)
    queue = observation[:, task.system.observation_dim :]
    assert (queue <= 1.0 + 1e-6).all()
