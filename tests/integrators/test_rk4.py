"""The classical Runge-Kutta step."""

from __future__ import annotations

import math

import pytest
import torch
from torchdiffeq import odeint

from phihp_torchrl import get_task
from phihp_torchrl.integrators import RK4, StateLayout

from .oscillator import FREE, error_after_one_second, oscillator, world


def test_halving_the_step_divides_the_error_by_two_to_the_fourth():
    coarse, fine = (error_after_one_second("rk4", steps) for steps in (40, 80))
    assert math.log2(coarse / fine) == pytest.approx(4, abs=0.1)


def test_a_step_of_a_linear_equation_is_its_taylor_sum():
    new = RK4()(lambda s: s, torch.ones(1, dtype=torch.float64), 0.5, StateLayout(size=1))
    assert new.item() == pytest.approx(sum(0.5**k / math.factorial(k) for k in range(5)), rel=1e-12)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_it_agrees_with_torchdiffeq_on_the_physics(name):
    task = get_task(name)
    _, state, action = world(name, "rk4")
    # Without the jump of dry friction, so that every scheme has its order.
    slope = lambda s: task.system.prior(s, action, task.system.constants)  # noqa: E731
    times = torch.tensor([0.0, 0.02], dtype=torch.float64)
    ours = RK4()(slope, state, 0.02, task.system.layout())
    for method in ("dopri5", "rk4"):
        theirs = odeint(lambda _, s: slope(s), state, times, method=method, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(ours, theirs[-1], rtol=1e-6, atol=1e-6)


def test_limits_apply_after_every_substep():
    layout = StateLayout(size=2, pairs=((0, 1),), limits=(1.0,))
    state = torch.tensor([2.0, 0.0], dtype=torch.float64)
    new = RK4(substeps=2)(oscillator, state, 1.0, layout)
    half = layout.clip(RK4()(oscillator, state, 0.5, FREE))
    torch.testing.assert_close(new, layout.clip(RK4()(oscillator, half, 0.5, FREE)))
    assert new[1] == -1.0
