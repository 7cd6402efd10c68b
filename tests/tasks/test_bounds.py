"""Bounds of an action: clipping, and units of the half-range around the middle."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.tasks import ActionBounds

inf = math.inf
finite = st.floats(-1e3, 1e3)
pairs = st.tuples(finite, st.floats(1e-3, 1e3)).map(lambda p: (p[0], p[0] + p[1]))
"""Any finite bounds, asymmetric ones most of the time."""
open_pairs = st.one_of(
    pairs,
    finite.map(lambda low: (low, inf)),
    finite.map(lambda high: (-inf, high)),
    st.just((-inf, inf)),
)


def bounds_of(limits):
    low, high = zip(*limits, strict=True)
    return ActionBounds.from_limits(
        torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    )


def draw_actions(limits, seed, spread=3e3):
    generator = torch.Generator().manual_seed(seed)
    return spread * torch.randn(2, 5, len(limits), generator=generator, dtype=torch.float64)


@given(st.lists(open_pairs, min_size=1, max_size=3), st.integers(0, 99))
def test_clipping_keeps_actions_in_bounds_and_those_that_are(limits, seed):
    bounds, action = bounds_of(limits), draw_actions(limits, seed)
    clipped = bounds.clip(action)
    assert ((clipped >= bounds.low) & (clipped <= bounds.high)).all()
    inside = (action >= bounds.low) & (action <= bounds.high)
    assert torch.equal(clipped[inside], action[inside])
    assert torch.equal(bounds.clip(clipped), clipped)


@given(st.lists(open_pairs, min_size=1, max_size=3), st.integers(0, 99))
def test_units_of_the_half_range_and_back(limits, seed):
    bounds, action = bounds_of(limits), draw_actions(limits, seed)
    torch.testing.assert_close(bounds.from_unit(bounds.to_unit(action)), action)
    unit = action / 3e3
    torch.testing.assert_close(bounds.to_unit(bounds.from_unit(unit)), unit, rtol=1e-6, atol=1e-6)


@given(st.lists(pairs, min_size=1, max_size=3))
def test_the_bounds_are_minus_one_and_one_and_the_middle_is_zero(limits):
    bounds = bounds_of(limits)
    one = torch.ones_like(bounds.low)
    torch.testing.assert_close(bounds.to_unit(bounds.low), -one)
    torch.testing.assert_close(bounds.to_unit(bounds.high), one)
    torch.testing.assert_close(bounds.from_unit(0 * one), (bounds.low + bounds.high) / 2)
    torch.testing.assert_close(bounds.scale, (bounds.high - bounds.low) / 2)


@given(st.lists(open_pairs, min_size=1, max_size=3))
def test_without_a_bound_actions_are_in_their_own_unit(limits):
    bounds = bounds_of(limits)
    is_open = ~(bounds.low.isfinite() & bounds.high.isfinite())
    # Zero, or as near to it as leaves a unit of the action between it and the one bound.
    low, high, center = (part[is_open] for part in (bounds.low, bounds.high, bounds.center))
    assert (center >= low + 1).all()
    assert (center <= high - 1).all()
    assert ((center == 0) | (center == low + 1) | (center == high - 1)).all()
    assert (bounds.scale[is_open] == 1).all()
    assert all(part.isfinite().all() for part in (bounds.center, bounds.scale))


@pytest.mark.parametrize(
    ("low", "high", "center", "scale"),
    [
        ((-2.0,), (2.0,), [0.0], [2.0]),
        ((-6.0,), (12.0,), [3.0], [9.0]),
        ((0.0,), (100.0,), [50.0], [50.0]),
        ((0.0, -inf), (inf, 1.0), [1.0, 0.0], [1.0, 1.0]),
        ((-1.0, 0.0), (1.0, 4.0), [0.0, 2.0], [1.0, 2.0]),
        ((-3e38,), (3e38,), [0.0], [3e38]),
    ],
)
def test_middle_and_half_range_by_hand(low, high, center, scale):
    bounds = ActionBounds.from_limits(low, high)
    assert (bounds.center.tolist(), bounds.scale.tolist()) == (center, pytest.approx(scale))
    assert (bounds.low.tolist(), bounds.high.tolist()) == (
        pytest.approx([*low]),
        pytest.approx([*high]),
    )
    assert {part.dtype for part in bounds} == {torch.float32}


def test_symmetric_bounds_scale_without_rounding():
    bounds = ActionBounds.from_limits((-2.0,), (2.0,))
    action = torch.randn(100, 1)
    assert torch.equal(bounds.from_unit(action), 2 * action)
    assert torch.equal(bounds.to_unit(action), action / 2)


def test_splitting_a_batch_changes_nothing():
    bounds = ActionBounds.from_limits((-6.0, 0.0), (12.0, 100.0))
    action = 50 * torch.randn(4, 3, 2)
    for function in (bounds.clip, bounds.to_unit, bounds.from_unit):
        rows = torch.stack([torch.stack([function(a) for a in row]) for row in action])
        assert torch.equal(function(action), rows)


def test_they_move_between_devices():
    moved = ActionBounds.from_limits((-6.0,), (12.0,)).to("meta")
    assert isinstance(moved, ActionBounds)
    assert all(part.device.type == "meta" for part in moved)
