"""The adaptive reference solver."""

from __future__ import annotations

import math

import pytest
import torch
from torchdiffeq import odeint

from phihp_torchrl import get_task
from phihp_torchrl.integrators import Dopri5
from phihp_torchrl.worlds import find_plant

from .oscillator import FREE, START, error_after_one_second, oscillator, rotate, world


def test_it_keeps_its_tolerance_in_one_long_step():
    assert error_after_one_second("dopri5", 1) < 1e-5
    tight = Dopri5(rtol=1e-11, atol=1e-12)(oscillator, START, 1.0, FREE)
    torch.testing.assert_close(tight, rotate(START, 1.0), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_it_agrees_with_torchdiffeq_on_the_physics(name):
    task = get_task(name)
    _, state, action = world(name, "rk4")
    # Without the jump of dry friction, so that every scheme has its order.
    slope = lambda s: task.system.prior(s, action, task.system.constants)  # noqa: E731
    times = torch.tensor([0.0, 0.02], dtype=torch.float64)
    ours = Dopri5(rtol=1e-10, atol=1e-10)(slope, state, 0.02, task.system.layout())
    for method, tolerance in (("dopri5", 1e-8), ("rk4", 1e-6)):
        theirs = odeint(lambda _, s: slope(s), state, times, method=method, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(ours, theirs[-1], rtol=tolerance, atol=tolerance)


def test_it_says_that_it_does_not_compile():
    assert not Dopri5.compiles


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_gets_past_a_cart_that_sticks_in_dry_friction(dtype):
    task = get_task("cartpole-swingup")
    plant = find_plant(task.system)
    calls = 0

    def slope(state):
        nonlocal calls
        calls += 1
        return plant.derivative(state, torch.full_like(state[..., :1], 0.05))

    state = torch.tensor([0.0, 5e-4, math.pi, 0.0], dtype=dtype)
    stuck = Dopri5()(slope, state, task.time_step, task.layout)
    assert calls < 1000
    assert stuck[1].abs() < 1e-4


@pytest.mark.parametrize("settings", [{"rtol": 0.0}, {"atol": -1.0}, {"rtol": math.nan}])
def test_tolerances_are_positive(settings):
    with pytest.raises(ValueError, match=r"^rtol, atol: expected positive"):
        Dopri5(**settings)
