"""Friction takes energy, stops push back and never pull; all of it for tensors and for SymPy."""

from __future__ import annotations

import math

import pytest
import sympy
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.systems import terms

speeds = st.floats(-50, 50)
sizes = st.floats(0.0, 20.0)


@given(speeds, sizes, st.floats(1e-3, 5.0))
def test_friction_acts_against_the_motion(speed, size, width):
    velocity = torch.tensor(speed, dtype=torch.float64)
    for force in (terms.viscous(velocity, size), terms.coulomb(velocity, size, width)):
        assert force * velocity <= 0
        assert force.isfinite()
    assert terms.coulomb(velocity, size, width).abs() <= size
    assert terms.viscous(velocity, size).item() == -size * speed


def test_dry_friction_is_full_after_a_few_widths_and_smooth_at_rest():
    velocity = torch.tensor([-0.5, 0.0, 0.1, 0.5], dtype=torch.float64, requires_grad=True)
    force = terms.coulomb(velocity, 2.0, width=0.1)
    expected = [2.0, 0.0, -2.0 * math.tanh(1.0), -2.0]
    assert force.tolist() == pytest.approx(expected, abs=1e-3)
    (slope,) = torch.autograd.grad(force.sum(), velocity)
    assert slope[1].item() == pytest.approx(-20.0)


@given(st.floats(-3, 3), speeds, sizes, sizes)
def test_a_stop_pushes_back_and_never_pulls(position, speed, stiffness, damping):
    x, v = torch.tensor([position, speed], dtype=torch.float64)
    force = terms.stop(x, v, -1.0, 2.0, stiffness, damping)
    if -1.0 <= position <= 2.0:
        assert force == 0
    else:
        assert force >= 0 if position < -1.0 else force <= 0
        depth = -1.0 - position if position < -1.0 else position - 2.0
        inward = -speed if position < -1.0 else speed
        assert abs(force.item()) == pytest.approx(max(0.0, depth * (stiffness + damping * inward)))


@given(st.floats(-3, 3), speeds, speeds, sizes, sizes, st.floats(0.1, 1.0))
def test_a_soft_stop_holds_and_never_pulls(position, speed, push, stiffness, damping, share):
    a, x, v = torch.tensor([push, position, speed], dtype=torch.float64)
    change = terms.soft_stop(a, x, v, -1.0, 2.0, stiffness, damping, share).item()
    mirrored = terms.soft_stop(-a, -x, -v, -2.0, 1.0, stiffness, damping, share).item()
    assert mirrored == pytest.approx(-change)
    if -1.0 <= position <= 2.0:
        assert change == 0
        return
    side = -1.0 if position < -1.0 else 1.0
    depth = -1.0 - position if position < -1.0 else position - 2.0
    assert side * change <= 0
    if change != 0:  # what is left of the push, and the way back
        back = damping * side * speed + stiffness * depth
        expected = (1 - share) * side * push - share * back
        assert side * (push + change) == pytest.approx(expected, abs=1e-9)


def test_a_soft_stop_carries_a_push_at_a_small_depth():
    x, v, push = torch.tensor([0.99, 1.0, 5.0], dtype=torch.float64)
    for _ in range(5000):
        v = v + 1e-3 * (push + terms.soft_stop(push, x, v, -1.0, 1.0, 100.0, 20.0, 0.9))
        x = x + 1e-3 * v
    assert v.abs() < 1e-6
    assert x.item() == pytest.approx(1.0 + 0.1 * 5.0 / (0.9 * 100.0), abs=1e-6)


@pytest.mark.parametrize(("damping", "kept"), [(0.0, 1.0), (100.0, None)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_bounce_keeps_the_energy_without_damping_and_loses_some_with_it(damping, kept, side):
    x, v = torch.zeros((), dtype=torch.float64), torch.tensor(side, dtype=torch.float64)
    for _ in range(4000):  # semi-implicit Euler
        v = v + 1e-3 * terms.stop(x, v, -1.0, 1.0, 200.0, damping)
        x = x + 1e-3 * v
        if abs(x) < 1.0 and v * side < 0:
            break
    if kept is not None:
        assert v.item() == pytest.approx(-side * kept, rel=1e-2)
    else:
        assert 0.1 < abs(v.item()) < 0.95


def test_terms_of_symbols_are_those_of_tensors():
    x, v, c = sympy.symbols("x v c", real=True)
    at = {x: 1.3, v: -0.4, c: 0.7}
    numbers = {symbol: torch.tensor(value, dtype=torch.float64) for symbol, value in at.items()}
    for term in (
        lambda x, v, c: terms.viscous(v, c),
        lambda x, v, c: terms.coulomb(v, c, 0.3),
        lambda x, v, c: terms.coulomb(v, 0.2, c),
        lambda x, v, c: terms.stop(x, v, -1, c, 30, 4),
        lambda x, v, c: terms.stop(-x, v, -1, 1, 30 * c, c),
        lambda x, v, c: terms.soft_stop(3 * c, x, v, -1, 1, 30, 4, c),
        lambda x, v, c: terms.soft_stop(-c, -x, v, -c, 1, 30 * c, c),
    ):
        expected = term(*numbers.values()).item()
        assert float(term(x, v, c).subs(at)) == pytest.approx(expected)
        assert expected != 0


def test_one_graph_and_gradients():
    x, v = torch.randn(2, 32, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    both = lambda x, v: terms.stop(x, v, -0.3, 0.4, 9.0, 2.0) + terms.coulomb(v, 0.3)  # noqa: E731
    compiled = torch.compile(both, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x, v), both(x, v))
    assert torch.autograd.gradcheck(both, (x.requires_grad_(), v.requires_grad_()))
