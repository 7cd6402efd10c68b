"""Transitions of recordings, in the form of those of a world."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Actuator, Signal, Task, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import Recording, transitions
from phihp_torchrl.worlds import SimulatedWorld
from tests.followed import WIND, Mass, followed

PENDULUM = get_task("pendulum")


def recording(count: int = 6, **changes: torch.Tensor) -> Recording:
    parts = {
        "time": 0.05 * torch.arange(count, dtype=torch.float64),
        "state": torch.randn(count, 2),
        "action": torch.rand(count, 1) - 0.5,
    }
    return Recording(**{**parts, **changes})


def test_they_have_the_states_the_commands_and_the_time_steps_of_the_log() -> None:
    time = torch.tensor([0.0, 0.05, 0.11, 0.13, 0.2, 0.3]).double()
    log = recording(time=time)
    data = transitions(PENDULUM, [log])
    assert data.batch_size == (5,)
    assert torch.equal(data["time_step"][:, 0], time.diff().float())
    assert torch.equal(data["observation"], PENDULUM.observe(log.state)[:-1].float())
    assert torch.equal(data["next", "observation"], PENDULUM.observe(log.state)[1:].float())
    assert torch.equal(data["action"], log.action[:-1].float())
    reward = PENDULUM.reward(log.state[:-1], log.action[:-1], log.state[1:])
    assert torch.allclose(data["next", "reward"][:, 0], reward.float(), atol=1e-5)
    assert data["next", "done"].flatten().tolist() == [False] * 4 + [True]
    assert {v.dtype for v in data.values(True, True)} == {torch.float32, torch.bool}


def test_a_state_that_is_unknown_ends_what_came_before(caplog: pytest.LogCaptureFixture) -> None:
    state = torch.randn(6, 2)
    state[3, 1] = torch.nan
    with caplog.at_level(logging.WARNING):
        data = transitions(PENDULUM, [recording(state=state), recording()])
    assert data.batch_size == (3 + 5,)
    assert data["next", "done"].flatten().nonzero().flatten().tolist() == [1, 2, 7]
    assert "2 recorded transitions are left out: a state is unknown" in caplog.text


def test_a_command_beyond_the_bounds_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    action = torch.tensor([[0.0], [2.0001], [3.0], [0.0], [0.0], [0.0]])
    with caplog.at_level(logging.WARNING):
        data = transitions(PENDULUM, [recording(action=action)])
    assert data["action"].flatten().tolist() == [0.0, 2.0, 0.0, 0.0]
    assert "1 recorded transitions are left out: their commands are beyond" in caplog.text
    assert "check the unit and scale of the column, or widen" in caplog.text


def test_a_log_most_of_whose_commands_are_beyond_the_bounds_is_refused() -> None:
    wrong = recording(action=torch.tensor([[0.0], [-1500.0], [900.0], [1.5], [2000.0], [0.0]]))
    expected = (
        r"3 of 5 transitions would be left out: .* beyond the bounds of task 'pendulum', "
        r"\(-2.0,\) to \(2.0,\); check the unit and scale.*, or widen.* torque from -1500 to 2000"
    )
    with pytest.raises(ConfigError, match=expected):
        transitions(PENDULUM, [wrong])
    # Another log, all of whose commands are good, makes it a minority.
    assert len(transitions(PENDULUM, [wrong, recording()])) == 2 + 5
    with pytest.raises(ConfigError, match="5 of 5 transitions"):
        transitions(PENDULUM, [recording(action=torch.full((6, 1), 9.0))])


def test_states_that_are_unknown_count_neither_way() -> None:
    state = torch.randn(9, 2)
    state[4:] = torch.nan
    action = torch.tensor([9.0, 9.0, 0.5, 9.0, *[0.5] * 5])[:, None]
    with pytest.raises(ConfigError, match="2 of 3 transitions"):
        transitions(PENDULUM, [recording(9, state=state, action=action)])
    state[::2] = torch.nan
    with pytest.raises(ConfigError, match="no transition can be used"):
        transitions(PENDULUM, [recording(9, state=state, action=9.0 * action)])


def test_a_log_most_of_whose_commands_change_too_fast_is_refused() -> None:
    slow = replace(PENDULUM, action_rate_limit=1.0)
    expected = (
        r"4 of 5 transitions .* faster than the action_rate_limit .* check the unit.*"
        r"by up to 40 a second"
    )
    jumps = torch.tensor([0.0, 1.0, -1.0, 1.0, -1.0, 1.0])[:, None]
    with pytest.raises(ConfigError, match=expected):
        transitions(slow, [recording(action=jumps)])


def test_the_task_says_where_an_episode_ends() -> None:
    task = get_task("cartpole")
    state = torch.zeros(4, 4)
    state[2, 2] = 3.0
    log = Recording(torch.arange(4), state, torch.zeros(4, 1))
    data = transitions(task, [log])
    following = task.locate(data["next", "observation"])
    assert data["next", "terminated"][:, 0].tolist() == task.is_terminated(following).tolist()
    assert data["next", "terminated"].any()


def test_a_state_that_nobody_measured_is_refused() -> None:
    state = torch.full((6, 2), torch.nan)
    state[:, 0] = 0.0
    with pytest.raises(ConfigError, match=r"expected a measured 'theta_dot'.*estimate_velocities"):
        transitions(PENDULUM, [recording(state=state)])
    with pytest.raises(ConfigError, match=r"expected states .* got 3 and 1 columns"):
        transitions(PENDULUM, [recording(state=torch.zeros(6, 3))])
    with pytest.raises(ConfigError, match="no transition"):
        transitions(PENDULUM, [])


def test_what_is_under_way_follows_the_commands_of_a_recording():
    task = replace(get_task("pendulum"), actuator=Actuator(delay_steps=2.0))
    commands = torch.tensor([[1.0], [-2.0], [0.5], [2.0]])
    first = Recording(torch.arange(4) * 0.05, torch.zeros(4, 2), commands, source="a.csv")
    data = transitions(task, [first])
    waiting = data["observation"][:, task.system.observation_dim :]
    assert waiting.tolist() == [[0.0, 0.0], [0.0, 0.5], [0.5, -1.0]]


def test_a_stretch_that_goes_on_lacks_what_was_under_way():
    task = replace(get_task("pendulum"), actuator=Actuator(delay_steps=2.0))
    times = torch.arange(5) * task.time_step
    first = Recording(times, torch.zeros(5, 2), torch.zeros(5, 1), source="a.csv")
    second = replace(first, time=times + 10.0)
    assert len(transitions(task, [first, second])) == 4 + 2
    assert len(transitions(task, [first, replace(second, episode=1)])) == 4 + 4


def test_a_reference_stands_in_the_middle_of_its_range() -> None:
    def follow(state, action, next_state, reference):
        return -(next_state[..., 1] - reference[..., 0]).abs()

    asked = Signal(("theta_dot",), low=(0.0,), high=(4.0,), preview=1)
    task, log = replace(PENDULUM, reward=follow, reference=asked), recording()
    data = transitions(task, [log])
    assert torch.allclose(data["next", "reward"][:, 0], -(log.state[1:, 1].float() - 2.0).abs())
    state = task.locate(data["observation"])
    assert torch.equal(
        task.outside.values(task.split(state)[1])["reference"], torch.full((5, 1), 2.0)
    )


def registers(task: Task, observation: torch.Tensor) -> dict[str, torch.Tensor]:
    return task.outside.split(task.split(task.locate(observation))[1])


def test_inputs_are_those_of_the_recording_and_act_until_the_next_sample() -> None:
    task, wind = followed(Mass()), torch.linspace(-2.0, 2.0, 6)[:, None]
    data = transitions(task, [recording(inputs=wind)])
    assert torch.allclose(registers(task, data["observation"])["inputs"], wind[:-1])
    assert torch.allclose(registers(task, data["next", "observation"])["inputs"], wind[1:])
    assert not registers(task, data["observation"])["reference"].any()  # the middle of its range
    acting, _ = task.acting(task.split(task.locate(data["observation"]))[1], data["action"])
    assert torch.allclose(acting, torch.cat([data["action"], wind[:-1]], -1))


def test_a_preview_ends_with_its_recording() -> None:
    task, wind = followed(Mass(), inputs=replace(WIND, preview=2)), torch.arange(4.0)[:, None] / 2
    data = transitions(task, [recording(4, inputs=wind), recording(4, inputs=-wind)])
    known = torch.tensor([[0.0, 0.5, 1.0], [0.5, 1.0, 1.5], [1.0, 1.5, 1.5]])
    after = torch.tensor([[0.5, 1.0, 1.5], [1.0, 1.5, 1.5], [1.5, 1.5, 1.5]])
    seen = registers(task, data["observation"])["inputs"]
    assert torch.allclose(seen, torch.cat([known, -known]))
    seen = registers(task, data["next", "observation"])["inputs"]
    assert torch.allclose(seen, torch.cat([after, -after]))


def test_inputs_stand_before_what_is_under_way() -> None:
    task = followed(Mass(), actuator=Actuator(delay_steps=1.0))
    log = recording(inputs=torch.rand(6, 1))
    state = task.locate(transitions(task, [log])["observation"])
    assert torch.allclose(state[:, 2], log.inputs[:-1, 0].float())
    assert torch.allclose(state[1:, -1], log.action[:-2, 0].float())


def test_they_are_laid_out_as_those_of_a_world() -> None:
    task = followed(Mass(), inputs=replace(WIND, preview=1))
    torch.manual_seed(0)
    env = SimulatedWorld(task).make_env()
    steps = env.rollout(10)
    state = task.locate(torch.cat([steps["observation"], steps["next", "observation"][-1:]]))
    wind = task.outside.values(task.split(state)[1])["inputs"]
    action = torch.cat([steps["action"], steps["action"][-1:]])
    log = Recording(task.time_step * torch.arange(11), state[:, :2], action, inputs=wind)
    data = transitions(task, [log])
    own = task.locate(data["observation"])
    assert torch.allclose(own[:, :4], state[:-1, :4], atol=1e-5)  # the rest is the reference


def test_recordings_without_the_inputs_of_a_system_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"each of the inputs \('wind',\) of Mass, got 0"):
        transitions(followed(Mass()), [recording()])
    with pytest.raises(ConfigError, match=r"each of the inputs \(\) of Pendulum, got 1"):
        transitions(PENDULUM, [recording(inputs=torch.zeros(6, 1))])


def test_inputs_of_a_recording_are_finite_and_as_many_as_its_samples() -> None:
    with pytest.raises(ConfigError, match=r"inputs: .* expected finite inputs"):
        recording(inputs=torch.full((6, 1), torch.nan))
    for wrong in (torch.zeros(5, 1), torch.zeros(6), torch.zeros(0, 1)):
        with pytest.raises(ConfigError, match=r"inputs: .* expected shape \[6, ...\]"):
            recording(inputs=wrong)
    none = recording()
    assert none.inputs.shape == (6, 0)
    assert none.inputs.dtype == torch.float64
    shorter = replace(none, time=none.time[:4], state=none.state[:4], action=none.action[:4])
    assert shorter.inputs.shape == (4, 0)
