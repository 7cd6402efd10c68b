"""PID loops: offset, windup, tuning, memory, and names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import ConfigError, HybridDynamics, get_task
from phihp_torchrl.baselines import PID
from phihp_torchrl.tasks import Actuator

from .parts import Leak, Slider, Stray, Tank, TwoTanks, following, play, prior_of, task_of


def test_its_integral_leaves_no_offset() -> None:
    task, leaking = task_of(Tank()), task_of(Leak())
    pid = PID.from_model(task, prior_of(task), goal=[0.5])
    states = play(pid, task, torch.zeros(1), 200, prior_of(leaking))
    assert states[-1].item() == pytest.approx(0.5, abs=1e-3)
    assert pid.gains["inflow"].d == 0.0


def test_its_integral_stands_still_while_the_action_is_on_its_bound() -> None:
    task = task_of(Tank())
    pid = PID.from_model(task, prior_of(task), goal=[0.9], time_constant=0.4)
    # Fifty steps of an error that holds the action on its bound, and then the level is reached.
    far = TensorDict(observation=torch.tensor([-30.0]))
    for _ in range(50):
        assert pid(far)["action"].item() == 5.0
    states = play(_keeping(pid), task, torch.tensor([0.9]), 30)
    assert (states - 0.9).abs().max() < 1e-3


def _keeping(pid: PID):
    """The controller without word of a new episode."""
    return lambda data: pid(data.exclude("is_init"))


def test_poles_are_where_lambda_says() -> None:
    task = task_of(Slider())
    pid = PID.from_model(task, prior_of(task), time_constant=2.0)
    gains = pid.gains["force"]
    # (s + 1/2)³ for 2 x'' = u
    assert gains.p == pytest.approx(2 * 3 / 4, rel=0.01)
    assert gains.i == pytest.approx(2 / 8, rel=0.01)
    assert gains.d == pytest.approx(2 * 3 / 2, rel=0.01)


def test_dead_time_makes_slower_loops_that_still_work() -> None:
    prompt, late = task_of(Slider()), task_of(Slider(), Actuator(delay_steps=3.0))
    quick, slow = (PID.from_model(task, prior_of(task)) for task in (prompt, late))
    assert slow.gains["force"].time_constant > 1.5 * quick.gains["force"].time_constant
    assert slow.gains["force"].peak <= 1.7
    start = late.at_rest(torch.tensor([[0.2, 0.0], [-0.1, 0.1]]))
    assert play(slow, late, start, 200)[-1, :, :2].abs().max() < 1e-2


def test_rows_are_apart_and_an_episode_starts_from_zero() -> None:
    task = task_of(Tank())
    pid = PID.from_model(task, prior_of(task), goal=[0.5], time_constant=1.0)
    observation = torch.tensor([[0.4], [0.6]])
    first = pid(TensorDict(observation=observation, batch_size=[2]))["action"]
    later = pid(TensorDict(observation=observation, batch_size=[2]))["action"]
    assert later[0] > first[0]
    assert later[1] < first[1]
    starts = torch.tensor([[True], [False]])
    data = TensorDict(observation=observation, is_init=starts, batch_size=[2])
    last = pid(data)["action"]
    assert last[0] == first[0]
    assert last[1] < later[1]
    pid.reset()
    again = pid(TensorDict(observation=observation, batch_size=[2]))["action"]
    torch.testing.assert_close(again, first)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_it_takes_any_batch_in_any_precision(shape: tuple[int, ...]) -> None:
    task = get_task("cartpole")
    pid = PID.from_model(task, HybridDynamics.pure_prior(task))
    assert pid.components == {"force": "theta"}
    for dtype in (torch.float32, torch.float64):
        data = TensorDict(observation=torch.ones(*shape, 5, dtype=dtype), batch_size=shape)
        action = pid(data)["action"]
        assert (action.shape, action.dtype) == ((*shape, 1), dtype)


def test_what_is_wrong_is_named() -> None:
    task = task_of(Slider())
    dynamics = prior_of(task)
    with pytest.raises(ConfigError, match=r"components: unknown \['push'\], expected .*'force'"):
        PID.from_model(task, dynamics, components={"push": "x"})
    with pytest.raises(ConfigError, match=r"components: unknown \['y'\], expected .*'x_dot'"):
        PID.from_model(task, dynamics, components={"force": "y"})
    late = task_of(Slider(), Actuator(delay_steps=9.0))
    with pytest.raises(ConfigError, match="component: expected a loop that force can stabilise"):
        PID.from_model(late, prior_of(late), time_constant=0.2)


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), 0.0, -1.0, "1 s", True])
def test_a_time_constant_that_is_none_is_refused(seconds: Any) -> None:
    task = task_of(Slider())
    with pytest.raises(ConfigError, match="time_constant: expected a positive number, got"):
        PID.from_model(task, prior_of(task), time_constant=seconds)


@pytest.mark.parametrize("one", [np.float32(1), np.int64(1), torch.tensor(1.0), 1])
def test_a_time_constant_of_numpy_or_torch_is_a_number(one: Any) -> None:
    task = task_of(Slider())
    expected = PID.from_model(task, prior_of(task), time_constant=1.0).gains
    assert PID.from_model(task, prior_of(task), time_constant=one).gains == expected


# References.


@pytest.mark.parametrize("preview", [0, 3])
@pytest.mark.parametrize("system", [Tank(), TwoTanks()])
def test_a_reference_is_its_set_point(system, preview: int) -> None:
    task = following(system, preview=preview)
    pid = PID.from_model(task, prior_of(task))
    assert pid.components == {"inflow": "level"}
    start = torch.zeros(2, system.state_dim)
    wanted = torch.tensor([[0.5], [2.5]])
    states = play(
        pid, task, task.with_signals(task.at_rest(start), wanted.repeat(1, 1 + preview)), 200
    )
    torch.testing.assert_close(states[-1, :, :1], wanted, atol=1e-3, rtol=0.0)
    assert (states[10, :, 0] - wanted[:, 0]).abs().min() > 1e-3


def test_a_step_response_tunes_what_answers_late() -> None:
    gains = PID.from_model(following(TwoTanks()), prior_of(task_of(TwoTanks()))).gains["inflow"]
    # 2 / ((s + 2) (2 s + 1)) has a gain of 2, and does 63 % of its way after about 2.5 s.
    lag, slope = 2.5, 2.0 / 2.5
    assert gains.i == pytest.approx(1.0 / gains.time_constant**2 / slope, rel=0.1)
    assert gains.p == pytest.approx((2.0 / gains.time_constant - 1.0 / lag) / slope, rel=0.1)
    assert gains.peak <= 1.7


def test_a_residual_that_moves_all_at_once_does_not_hide_the_way_through_another() -> None:
    task = following(TwoTanks())
    torch.manual_seed(0)
    learned = HybridDynamics.hybrid(task)
    with torch.no_grad():
        for weight in learned.residual.parameters():
            weight.mul_(0.3)
    found, prior = (
        PID.from_model(task, model).gains["inflow"] for model in (learned, prior_of(task))
    )
    assert found.i == pytest.approx(prior.i, rel=0.3)


def test_dead_time_is_in_the_model_of_a_task_with_a_reference() -> None:
    late = replace(following(Tank(), preview=2), actuator=Actuator(delay_steps=3.0))
    pid = PID.from_model(late, prior_of(late))
    prompt = PID.from_model(following(Tank()), prior_of(following(Tank())))
    assert pid.gains["inflow"].time_constant > 1.5 * prompt.gains["inflow"].time_constant
    start = late.with_signals(late.at_rest(torch.zeros(1, 1)), torch.full((1, 3), 2.5))
    states = play(pid, late, start, 200)
    assert (states[100:, 0, 0] - 2.5).abs().max() < 0.01


def test_a_reference_that_nothing_moves_is_refused() -> None:
    task = following(Stray(), "drift")
    with pytest.raises(ConfigError, match="components: expected some that an action moves"):
        PID.from_model(task, prior_of(task), goal=[0.0, 0.0, 0.0])
