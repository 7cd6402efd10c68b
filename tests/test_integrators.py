"""Integrators: their order, their limits, and that they batch, differentiate and compile."""

from __future__ import annotations

import math

import pytest
import torch
from torchdiffeq import odeint

from phihp_torchrl import get_task
from phihp_torchrl.integrators import (
    RK4,
    Dopri5,
    SemiImplicitEuler,
    StateLayout,
    make_integrator,
)
from phihp_torchrl.tasks import list_tasks

FIXED_STEP = ["semi_implicit_euler", "rk4"]
ALL = [*FIXED_STEP, "dopri5"]
FREE = StateLayout(size=2, pairs=((0, 1),), limits=(math.inf,))
START = torch.tensor([[1.0, 0.0], [0.3, -0.8]], dtype=torch.float64)


def oscillator(state):
    """x'' = -x: the exact solution rotates the phase plane."""
    return torch.stack([state[..., 1], -state[..., 0]], -1)


def rotate(state, time):
    x, v = state.unbind(-1)
    cos, sin = math.cos(time), math.sin(time)
    return torch.stack([cos * x + sin * v, cos * v - sin * x], -1)


def error_after_one_second(integrator, steps):
    state = START
    for _ in range(steps):
        state = make_integrator(integrator)(oscillator, state, 1.0 / steps, FREE)
    return (state - rotate(START, 1.0)).abs().max().item()


def world(name, integrator, *, n=6, dtype=torch.float64):
    """A step function of a real world, with states and actions to step."""
    task = get_task(name)
    generator = torch.Generator().manual_seed(0)
    state = task.coverage.sample([n], generator=generator, dtype=dtype)
    action = torch.rand(n, task.system.action_dim, generator=generator, dtype=dtype) - 0.5
    return lambda s, a: task.step(s, a, integrator), state, action


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit_euler", 1), ("rk4", 4)])
def test_halving_the_step_divides_the_error_by_two_to_the_order(integrator, order):
    coarse, fine = (error_after_one_second(integrator, steps) for steps in (40, 80))
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.1)


def test_dopri5_keeps_its_tolerance_in_one_long_step():
    assert error_after_one_second("dopri5", 1) < 1e-5
    tight = Dopri5(rtol=1e-11, atol=1e-12)(oscillator, START, 1.0, FREE)
    torch.testing.assert_close(tight, rotate(START, 1.0), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_schemes_agree_with_torchdiffeq_on_the_physics(name):
    task = get_task(name)
    _, state, action = world(name, "rk4")
    # Without the jump of dry friction, so that every scheme has its order.
    slope = lambda s: task.system.prior(s, action, task.system.constants)  # noqa: E731
    times = torch.tensor([0.0, 0.02], dtype=torch.float64)
    layout = task.system.layout()
    for method, tolerance in (("dopri5", 1e-8), ("rk4", 1e-6)):
        theirs = odeint(lambda _, s: slope(s), state, times, method=method, rtol=1e-10, atol=1e-10)
        for ours in (RK4(), Dopri5(rtol=1e-10, atol=1e-10)):
            bound = max(tolerance, 1e-6 if isinstance(ours, RK4) else 0.0)
            result = ours(slope, state, 0.02, layout)
            torch.testing.assert_close(result, theirs[-1], rtol=bound, atol=bound)
    euler = SemiImplicitEuler()(slope, state, 0.02, layout)
    torch.testing.assert_close(euler, theirs[-1], rtol=0.05, atol=0.05)


def test_semi_implicit_euler_moves_positions_with_the_new_velocities():
    state = torch.tensor([1.0, 0.5])
    new = SemiImplicitEuler()(oscillator, state, 0.1, FREE)
    assert new.tolist() == pytest.approx([1.0 + 0.1 * (0.5 - 0.1), 0.5 - 0.1])


def test_semi_implicit_euler_takes_an_explicit_step_for_first_order_components():
    layout = StateLayout(size=3, pairs=((0, 1),), limits=(math.inf,))
    decay = lambda s: torch.stack([s[..., 1], -s[..., 0], -s[..., 2]], -1)  # noqa: E731
    new = SemiImplicitEuler()(decay, torch.tensor([0.0, 0.0, 2.0]), 0.1, layout)
    assert new.tolist() == pytest.approx([0.0, 0.0, 1.8])


def test_semi_implicit_euler_keeps_what_is_learned_on_top_of_the_kinematics():
    drift = lambda s: oscillator(s) + torch.tensor([0.3, 0.0])  # noqa: E731
    state = torch.tensor([1.0, 0.5])
    gap = SemiImplicitEuler()(drift, state, 0.1, FREE) - SemiImplicitEuler()(
        oscillator, state, 0.1, FREE
    )
    assert gap.tolist() == pytest.approx([0.03, 0.0], abs=1e-6)


@pytest.mark.parametrize("integrator", ALL)
def test_velocity_limits_hold(integrator):
    layout = StateLayout(size=2, pairs=((0, 1),), limits=(1.5,))
    push = lambda s: torch.stack([s[..., 1], torch.full_like(s[..., 0], 100.0)], -1)  # noqa: E731
    new = make_integrator(integrator)(push, START, 0.1, layout)
    assert (new[:, 1] == 1.5).all()
    if integrator == "semi_implicit_euler":  # positions see the clipped velocity
        torch.testing.assert_close(new[:, 0], START[:, 0] + 0.15)


@pytest.mark.parametrize("integrator", FIXED_STEP)
@pytest.mark.parametrize("name", list_tasks())
def test_splitting_a_batch_changes_nothing(name, integrator):
    step, state, action = world(name, integrator)
    joint = step(state, action)
    split = torch.stack([step(s, a) for s, a in zip(state, action, strict=True)])
    torch.testing.assert_close(joint, split, rtol=1e-13, atol=1e-13)
    folded = step(state.reshape(2, 3, -1), action.reshape(2, 3, -1))
    torch.testing.assert_close(folded.flatten(0, 1), joint, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    "integrator", [*FIXED_STEP, pytest.param(Dopri5(rtol=1e-9, atol=1e-10), id="dopri5")]
)
@pytest.mark.parametrize("name", ["pendulum", "cartpole-swingup", "acrobot-swingup"])
def test_gradients_flow_through_a_step(name, integrator):
    step, state, action = world(name, integrator, n=2)
    state.requires_grad_()
    action.requires_grad_()
    assert torch.autograd.gradcheck(step, (state, action), fast_mode=True)


@pytest.mark.parametrize("integrator", ALL)
def test_gradients_reach_the_constants(integrator):
    system = get_task("pendulum").system
    gravity = torch.tensor(9.0, dtype=torch.float64, requires_grad=True)

    def slope(state):
        constants = {**system.constants, "gravity": gravity}
        return system.prior(state, torch.zeros_like(state[..., :1]), constants)

    make_integrator(integrator)(slope, START, 0.05, FREE).sum().backward()
    assert gravity.grad.abs() > 0


@pytest.mark.parametrize("integrator", ALL)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(integrator, dtype):
    assert make_integrator(integrator)(oscillator, START.to(dtype), 0.1, FREE).dtype == dtype


@pytest.mark.parametrize("integrator", FIXED_STEP)
@pytest.mark.parametrize("name", ["pendulum", "cartpole-swingup", "acrobot"])
def test_fixed_step_schemes_are_one_graph(name, integrator):
    assert make_integrator(integrator).compiles
    step, state, action = world(name, integrator)
    torch.compiler.reset()
    compiled = torch.compile(step, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(state, action), step(state, action))


def test_dopri5_says_that_it_does_not_compile():
    assert not Dopri5.compiles


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dopri5_gets_past_a_cart_that_sticks_in_dry_friction(dtype):
    task = get_task("cartpole-swingup")
    calls = 0

    def slope(state):
        nonlocal calls
        calls += 1
        return task.system.derivative(state, torch.full_like(state[..., :1], 0.05))

    state = torch.tensor([0.0, 5e-4, math.pi, 0.0], dtype=dtype)
    stuck = Dopri5()(slope, state, task.time_step, task.layout)
    assert calls < 1000
    assert stuck[1].abs() < 1e-4


def test_a_broken_state_spoils_its_own_row_or_is_refused():
    state = torch.tensor([[math.nan, 0.0], [1.0, 0.0]])
    for integrator in FIXED_STEP:
        new = make_integrator(integrator)(oscillator, state, 0.1, FREE)
        assert new[0].isnan().any()
        assert new[1].isfinite().all()
    with pytest.raises(ValueError, match=r"^state: expected finite"):
        Dopri5()(oscillator, state, 0.1, FREE)


def test_integrators_are_found_by_name():
    kinds = [type(make_integrator(name)) for name in ALL]
    assert kinds == [SemiImplicitEuler, RK4, Dopri5]
    instance = Dopri5(rtol=1e-3)
    assert make_integrator(instance) is instance


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"^integrator: expected one of \['dopri5'.*got 'euler'"):
        make_integrator("euler")
    with pytest.raises(ValueError, match=r"^rtol, atol: expected positive"):
        Dopri5(rtol=0.0)
    with pytest.raises(ValueError, match=r"^limits: expected one per"):
        StateLayout(size=2, pairs=((0, 1),))
    with pytest.raises(ValueError, match=r"^limits: expected positive"):
        StateLayout(size=2, pairs=((0, 1),), limits=(0.0,))
