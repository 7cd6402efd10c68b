"""What holds for every integrator: limits, batches, gradients, graphs; and how one is chosen."""

from __future__ import annotations

import math
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import (
    INTEGRATORS,
    RK4,
    Dopri5,
    SemiImplicitEuler,
    StateLayout,
    make_integrator,
)
from phihp_torchrl.tasks import list_tasks

from .oscillator import ALL, FIXED_STEP, FREE, START, error_after_one_second, oscillator, world

inf = math.inf

# The layout


@given(
    st.lists(
        st.tuples(st.floats(-9, 0), st.floats(0.01, 9)) | st.floats(0.01, 9) | st.just(inf),
        min_size=2,
        max_size=2,
    ),
    st.lists(st.floats(-20, 20), min_size=5, max_size=5),
)
def test_clipping_keeps_velocities_within_their_limits_and_all_else(limits, values):
    layout = StateLayout(size=5, pairs=((0, 2), (4, 1)), limits=tuple(limits))
    state = torch.tensor([values, values[::-1]], dtype=torch.float64)
    clipped = layout.clip(state)
    assert torch.equal(clipped[:, [0, 3, 4]], state[:, [0, 3, 4]])
    for velocity, given_limit, (low, high) in zip((2, 1), limits, layout.limits, strict=True):
        assert (low, high) == (
            given_limit if isinstance(given_limit, tuple) else (-given_limit, given_limit)
        )
        assert ((clipped[:, velocity] >= low) & (clipped[:, velocity] <= high)).all()
        inside = (state[:, velocity] >= low) & (state[:, velocity] <= high)
        assert torch.equal(clipped[inside, velocity], state[inside, velocity])
    assert torch.equal(layout.clip(clipped), clipped)
    assert layout.limited == (limits != [inf, inf])


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        (inf, [-5.0, 0.5, 5.0]),
        (2.0, [-2.0, 0.5, 2.0]),
        ((-1.0, 3.0), [-1.0, 0.5, 3.0]),
        ((0.0, inf), [0.0, 0.5, 5.0]),
        ((-inf, 0.25), [-5.0, 0.25, 0.25]),
    ],
)
def test_limits_may_be_one_sided(limit, expected):
    layout = StateLayout(size=2, pairs=((0, 1),), limits=(limit,))
    state = torch.tensor([[9.0, -5.0], [9.0, 0.5], [9.0, 5.0]])
    assert layout.clip(state).tolist() == [[9.0, value] for value in expected]
    assert layout.limited == (limit != inf)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ((), "expected one per (position, velocity) pair, 1, got 0"),
        ((1.0, 2.0), "expected one per (position, velocity) pair, 1, got 2"),
        ((0.0,), "expected low < high for each velocity"),
        ((-1.0,), "expected low < high for each velocity"),
        ((math.nan,), "expected low < high for each velocity"),
        (((2.0, 1.0),), "expected low < high for each velocity"),
        (((1.0, 1.0),), "expected low < high for each velocity"),
        (((1.0, 2.0, 3.0),), "expected low < high for each velocity"),
    ],
)
def test_bad_limits_are_named(limits, message):
    with pytest.raises(ConfigError, match=f"^limits: {re.escape(message)}"):
        StateLayout(size=2, pairs=((0, 1),), limits=limits)


# Steps


@pytest.mark.parametrize("limit", [(-1.5, 1.5), (-2.0, 0.5), (-inf, 0.25), (0.0, 1.0)])
@pytest.mark.parametrize("push", [100.0, -100.0])
@pytest.mark.parametrize("integrator", ALL)
def test_velocity_limits_hold(integrator, push, limit):
    layout = StateLayout(size=2, pairs=((0, 1),), limits=(limit,))
    slope = lambda s: torch.stack([s[..., 1], torch.full_like(s[..., 0], push)], -1)  # noqa: E731
    new = make_integrator(integrator)(slope, START, 0.1, layout)
    expected = (START[:, 1] + 0.1 * push).clamp(*limit)
    torch.testing.assert_close(new[:, 1], expected)
    if integrator == "semi_implicit_euler":  # positions see the clipped velocity
        torch.testing.assert_close(new[:, 0], START[:, 0] + 0.1 * expected)


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


@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("integrator", FIXED_STEP)
def test_fixed_step_schemes_are_one_graph(integrator, substeps):
    """The equations of every task are compiled with those of the models."""
    solver = make_integrator(integrator, substeps=substeps)
    assert solver.compiles
    step, state, action = world("pendulum", solver)
    torch.compiler.reset()
    compiled = torch.compile(step, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(state, action), step(state, action))


def test_a_broken_state_spoils_its_own_row_alone():
    state = torch.tensor([[math.nan, 0.0], [1.0, 0.0]])
    for integrator in (*(make_integrator(name) for name in FIXED_STEP), Dopri5()):
        new = integrator(oscillator, state, 0.1, FREE)
        assert new[0].isnan().any()
        assert new[1].isfinite().all()


# Substeps


@pytest.mark.parametrize("integrator", FIXED_STEP)
def test_substeps_are_shorter_steps_in_a_row(integrator):
    task = get_task("acrobot-swingup")
    once, state, action = world(task.name, make_integrator(integrator, substeps=4))
    solver = make_integrator(integrator)
    slow, _, _ = world(task.name, integrator)
    prior = lambda s: task.system.prior(s, action, task.system.constants)  # noqa: E731
    quarters = state
    for _ in range(4):
        quarters = solver(prior, quarters, task.time_step / 4, task.layout)
    substeps = make_integrator(integrator, substeps=4)
    assert torch.equal(substeps(prior, state, task.time_step, task.layout), quarters)
    assert not torch.allclose(once(state, action), slow(state, action))


@given(st.integers(2, 5), st.integers(10, 30))
def test_substeps_divide_the_error_by_their_number_to_the_order(factor, substeps):
    for integrator, order in (("semi_implicit_euler", 1), ("rk4", 4)):
        coarse = error_after_one_second(integrator, substeps=substeps)
        fine = error_after_one_second(integrator, substeps=factor * substeps)
        measured = math.log(coarse / fine) / math.log(factor)
        assert measured == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize("substeps", [0, -1, 1.5, True, math.nan])
@pytest.mark.parametrize("integrator", FIXED_STEP)
def test_substeps_are_a_whole_number(integrator, substeps):
    with pytest.raises(ConfigError, match=r"^substeps: expected a whole number >= 1, got "):
        make_integrator(integrator, substeps=substeps)


# By name


def test_integrators_are_found_by_name():
    assert list(INTEGRATORS) == ALL
    kinds = [type(make_integrator(name)) for name in ALL]
    assert kinds == [SemiImplicitEuler, RK4, Dopri5]
    instance = Dopri5(rtol=1e-3)
    assert make_integrator(instance) is instance


@pytest.mark.parametrize(
    "integrator", [SemiImplicitEuler(), RK4(3), Dopri5(), Dopri5(rtol=1e-3, atol=1e-4)]
)
def test_name_and_settings_make_it_again(integrator):
    again = make_integrator(integrator.name, **integrator.settings)
    assert type(again) is type(integrator)
    assert again.settings == integrator.settings
    for slope in (oscillator, lambda s: -s):
        one, other = (solver(slope, START, 0.3, FREE) for solver in (integrator, again))
        assert torch.equal(one, other)


def test_what_cannot_be_chosen_is_named():
    with pytest.raises(ConfigError, match=r"^integrator: expected one of \['dopri5'.*got 'euler'"):
        make_integrator("euler")
    with pytest.raises(ConfigError, match=r"^integrator: 'dopri5' has no such settings: .*substep"):
        make_integrator("dopri5", substeps=2)
    with pytest.raises(ConfigError, match=r"^integrator: 'rk4' has no such settings: .*rtol"):
        make_integrator("rk4", rtol=1e-3)


@pytest.mark.parametrize("name", ["semi_implicit_euler", "rk4", "dopri5"])
def test_time_steps_that_differ_are_integrated_as_such(name: str) -> None:
    integrator = make_integrator(name)
    layout = StateLayout(size=2, pairs=((0, 1),), limits=(math.inf,))
    state = torch.randn(2, 5, 2, dtype=torch.float64)
    seconds = 0.01 + 0.1 * torch.rand(2, 5, 1, dtype=torch.float64)

    def swing(s: torch.Tensor) -> torch.Tensor:
        return torch.stack([s[..., 1], -s[..., 0].sin()], -1)

    together = integrator(swing, state, seconds, layout)
    for i, j in ((0, 0), (1, 3)):
        alone = integrator(swing, state[i, j], seconds[i, j].item(), layout)
        assert torch.allclose(together[i, j], alone, atol=1e-6)
