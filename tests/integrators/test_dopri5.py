"""The adaptive reference solver."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchdiffeq import odeint

from phihp_torchrl import HybridDynamics, TaskWorldModel, get_task
from phihp_torchrl.integrators import Dopri5, StateLayout
from phihp_torchrl.planners import CEMConfig, make_planner
from phihp_torchrl.systems import Pendulum
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
    with pytest.raises(ValueError, match=r"^[ra]tol: expected a positive"):
        Dopri5(**settings)


def explode(state):
    """A law that runs away from 1, and is at rest at 0."""
    return state**3 * 1e4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("wrong", [3.0, 1e20, math.inf, math.nan])
def test_a_state_that_runs_away_becomes_nan_and_leaves_the_others_alone(dtype, wrong):
    layout = StateLayout(size=1)
    state = torch.tensor([[0.0], [wrong], [1e-4]], dtype=dtype)
    found = Dopri5()(explode, state, 0.1, layout)
    alone = Dopri5()(explode, state[[0, 2]], 0.1, layout)
    assert found[1].isnan().all()
    torch.testing.assert_close(found[[0, 2]], alone, rtol=1e-4, atol=1e-8)


def test_a_candidate_that_runs_away_loses():
    torch.manual_seed(0)
    task = get_task("pendulum")

    class Runaway(Pendulum):
        def prior(self, state, action, constants):
            away = torch.where(action > 1.0, 1e3 * state.abs() ** 3 + 1e3, torch.zeros_like(state))
            return super().prior(state, action, constants) + away

    task = replace(task, system=Runaway(), velocity_limits={})
    dynamics = HybridDynamics.pure_prior(task, integrator=Dopri5())
    settings = CEMConfig(
        planning_horizon=4, num_candidates=64, top_k=8, optim_steps=2, num_policy_candidates=0
    )
    planner = make_planner(TaskWorldModel(task, dynamics), None, None, settings)
    first = task.observe(torch.tensor([0.5, 0.0]))
    action = planner(TensorDict(observation=first, is_init=torch.ones(1).bool()))["action"]
    assert action.isfinite().all()
    assert action <= 1.0
