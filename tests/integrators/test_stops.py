"""Stops: limits of positions as an event after each solver step."""

from __future__ import annotations

import math
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import StateLayout, make_integrator

from .oscillator import ALL, FIXED_STEP, FREE, START, oscillator

inf = math.inf


def rail(restitution=0.0, stops=(-1.0, 0.5), limits=(inf,)):
    return StateLayout(2, ((0, 1),), limits, stops=(stops,), restitution=(restitution,))


@given(st.floats(-3, 3), st.floats(-9, 9), st.floats(0, 1))
def test_a_position_stays_on_its_limit_and_bounces(position, velocity, restitution):
    layout = rail(restitution)
    state = torch.tensor([position, velocity], dtype=torch.float64)
    x, v = layout.clip(state).tolist()
    assert x == min(max(position, -1.0), 0.5)
    outward = (position > 0.5 and velocity > 0) or (position < -1.0 and velocity < 0)
    assert v == (-restitution * velocity if outward else velocity)
    if -1.0 <= position <= 0.5:
        assert torch.equal(layout.clip(state), state)


@pytest.mark.parametrize(
    ("stops", "position", "expected"),
    [((0.0, inf), -2.0, 0.0), ((0.0, inf), 9.0, 9.0), ((-inf, 1.0), 2.0, 1.0)],
)
def test_stops_may_be_one_sided(stops, position, expected):
    assert rail(stops=stops).stop(torch.tensor([position, 0.0]))[0] == expected


def test_a_bounce_keeps_to_the_limits_of_the_velocity():
    layout = rail(1.0, limits=((-0.5, 8.0),))
    assert layout.clip(torch.tensor([0.7, 3.0])).tolist() == [0.5, -0.5]


def test_without_stops_nothing_is_done():
    state = torch.randn(4, 2)
    assert not FREE.stopped
    assert FREE.clip(state) is state
    assert FREE.stop(state) is state
    assert FREE.coupled(lambda pair, s: s) is FREE


@pytest.mark.parametrize("integrator", ALL)
def test_integrators_stop(integrator):
    solve = make_integrator(integrator)
    push = lambda s: torch.stack([s[..., 1], torch.full_like(s[..., 0], 4.0)], -1)  # noqa: E731
    state = torch.zeros(2, dtype=torch.float64)
    for _ in range(40):
        state = solve(push, state, 0.05, rail())
        assert state[0] <= 0.5
    assert state.tolist() == [0.5, 0.0]


@pytest.mark.parametrize("integrator", FIXED_STEP)
def test_stops_act_in_each_substep(integrator):
    layout, once = rail(0.8), make_integrator(integrator)
    fast = lambda s: torch.stack([s[..., 1], torch.zeros_like(s[..., 0])], -1)  # noqa: E731
    state = torch.tensor([0.0, 12.0], dtype=torch.float64)
    steps = state
    for _ in range(4):
        steps = once(fast, steps, 0.1, layout)
    whole = make_integrator(integrator, substeps=4)(fast, state, 0.4, layout)
    torch.testing.assert_close(whole, steps)
    assert steps[1] == pytest.approx(12.0 * 0.8**2)  # off the right stop, then off the left one


@pytest.mark.parametrize("integrator", FIXED_STEP)
def test_a_step_with_stops_is_one_graph_and_maps_over_a_batch(integrator):
    solve, layout = make_integrator(integrator, substeps=2), rail(0.5, stops=(-0.2, 0.29))
    step = lambda s: solve(oscillator, s, 0.1, layout)  # noqa: E731
    torch.compiler.reset()
    compiled = torch.compile(step, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(START), step(START))
    torch.testing.assert_close(torch.func.vmap(step)(START), step(START))


def test_gradients_pass_a_bounce():
    state = torch.tensor([[0.4, 3.0], [0.0, 1.0]], dtype=torch.float64, requires_grad=True)
    step = lambda s: make_integrator("rk4")(oscillator, s, 0.1, rail(0.5))  # noqa: E731
    assert torch.autograd.gradcheck(step, (state,))
    jacobian = torch.autograd.functional.jacobian(step, state)
    assert jacobian[0, 0].abs().max() == 0  # a position on its stop depends on nothing
    assert jacobian[0, 1, 0, 1] < 0


def test_a_broken_state_spoils_its_own_row():
    state = torch.tensor([[math.nan, 1.0], [0.7, 1.0]])
    after = rail().stop(state)
    assert after[0, 0].isnan()
    assert after[1].tolist() == [0.5, 0.0]


def test_a_blow_passes_to_other_velocities_and_keeps_the_energy():
    mass = torch.tensor([[2.0, 0.6], [0.6, 0.5]], dtype=torch.float64)
    columns = mass.inverse() / mass.inverse().diagonal()

    def impulse(pair, state):
        zero = torch.zeros_like(state[..., 0])
        return torch.stack([zero, zero + columns[0, pair], zero, zero + columns[1, pair]], -1)

    free = StateLayout(4, ((0, 1), (2, 3)), (inf, inf), ((-1.0, 1.0), (-inf, inf)), (1.0, 0.0))
    layout = free.coupled(impulse)
    state = torch.tensor([[1.1, 2.0, 0.3, -0.4], [0.9, 2.0, 0.3, -0.4]], dtype=torch.float64)
    after = layout.stop(state)
    assert torch.equal(after[1], state[1])
    assert after[0, [0, 1, 2]].tolist() == [1.0, -2.0, 0.3]
    energy = lambda s: torch.einsum("bi,ij,bj->b", s[:, 1::2], mass, s[:, 1::2])  # noqa: E731
    torch.testing.assert_close(energy(after), energy(state))
    assert free.stop(state)[0].tolist() == [1.0, -2.0, 0.3, -0.4]
    assert layout == free


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stops": ((1.0, 1.0),)}, "stops: expected low < high"),
        ({"stops": ((1.0, -1.0),)}, "stops: expected low < high"),
        ({"stops": ((math.nan, 1.0),)}, "stops: expected low < high"),
        ({"stops": ((0.0, 1.0), (0.0, 1.0))}, "stops: expected one per pair, 1, got 2"),
        ({"restitution": (1.1,)}, "restitution: expected values in [0, 1], got (1.1,)"),
        ({"restitution": (-0.1,)}, "restitution: expected values in [0, 1]"),
        ({"restitution": (0.1, 0.1)}, "restitution: expected one per pair, 1, got 2"),
    ],
)
def test_bad_stops_are_named(options, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        StateLayout(size=2, pairs=((0, 1),), limits=(1.0,), **options)
