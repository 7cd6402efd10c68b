"""Semi-implicit Euler: first order, kind to energy, and positions that follow velocities."""

from __future__ import annotations

import math

import pytest
import torch
from torchdiffeq import odeint

from phihp_torchrl import get_task
from phihp_torchrl.integrators import SemiImplicitEuler, StateLayout

from .oscillator import FREE, START, error_after_one_second, oscillator, world


def test_halving_the_step_halves_the_error():
    coarse, fine = (error_after_one_second("semi_implicit_euler", steps) for steps in (40, 80))
    assert math.log2(coarse / fine) == pytest.approx(1, abs=0.1)


def test_positions_move_with_the_new_velocities():
    state = torch.tensor([1.0, 0.5])
    new = SemiImplicitEuler()(oscillator, state, 0.1, FREE)
    assert new.tolist() == pytest.approx([1.0 + 0.1 * (0.5 - 0.1), 0.5 - 0.1])


def test_first_order_components_take_an_explicit_step():
    layout = StateLayout(size=3, pairs=((0, 1),), limits=(math.inf,))
    decay = lambda s: torch.stack([s[..., 1], -s[..., 0], -s[..., 2]], -1)  # noqa: E731
    new = SemiImplicitEuler()(decay, torch.tensor([0.0, 0.0, 2.0]), 0.1, layout)
    assert new.tolist() == pytest.approx([0.0, 0.0, 1.8])


def test_it_keeps_what_is_learned_on_top_of_the_kinematics():
    drift = lambda s: oscillator(s) + torch.tensor([0.3, 0.0])  # noqa: E731
    state = torch.tensor([1.0, 0.5])
    gap = SemiImplicitEuler()(drift, state, 0.1, FREE) - SemiImplicitEuler()(
        oscillator, state, 0.1, FREE
    )
    assert gap.tolist() == pytest.approx([0.03, 0.0], abs=1e-6)


def test_energy_neither_grows_nor_falls_over_a_hundred_turns():
    energy = lambda s: s.square().sum(-1)  # noqa: E731
    state, euler = START, SemiImplicitEuler()
    for _ in range(6283):
        state = euler(oscillator, state, 0.1, FREE)
    torch.testing.assert_close(energy(state), energy(START), rtol=0.1, atol=0)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_it_is_near_the_solution_of_the_physics(name):
    task = get_task(name)
    _, state, action = world(name, "rk4")
    slope = lambda s: task.system.prior(s, action, task.system.constants)  # noqa: E731
    times = torch.tensor([0.0, 0.02], dtype=torch.float64)
    theirs = odeint(lambda _, s: slope(s), state, times, method="rk4", rtol=1e-10, atol=1e-10)
    ours = SemiImplicitEuler()(slope, state, 0.02, task.system.layout())
    torch.testing.assert_close(ours, theirs[-1], rtol=0.05, atol=0.05)
