"""A box of states."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Box


@pytest.mark.parametrize(
    ("low", "high"),
    [((0.0,), ()), ((1.0,), (0.0,)), ((math.nan,), (1.0,)), ((-math.inf,), (0.0,))],
)
def test_its_corners_are_checked_by_name(low, high):
    with pytest.raises(ConfigError, match=r"^low(, high|\[0\]): "):
        Box(low, high)


def test_it_may_be_given_around_a_centre():
    assert Box.around((1.0, 2.0), (0.5, 0.0)) == Box((0.5, 2.0), (1.5, 2.0))
    with pytest.raises(ConfigError, match=r"^center, radius: "):
        Box.around((1.0, 2.0), (0.5,))
    with pytest.raises(ConfigError, match=r"^low, high: "):
        Box.around((1.0,), (-0.5,))


def test_samples_are_seeded():
    box = Box((0.0, -1.0), (0.0, 1.0))
    first, second = (
        box.sample([3, 2], generator=torch.Generator().manual_seed(7)) for _ in range(2)
    )
    assert torch.equal(first, second)
    assert first.shape == (3, 2, 2)
    assert (first[..., 0] == 0).all()
    assert box.sample([0]).shape == (0, 2)
    assert box.sample([], dtype=torch.float64).dtype == torch.float64


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(0, 1e3)), min_size=1, max_size=4))
def test_samples_lie_in_it(sides):
    low, high = zip(*((a, a + width) for a, width in sides), strict=True)
    states = Box(low, high).sample([50], dtype=torch.float64)
    tolerance = 1e-9
    assert (states >= torch.tensor(low, dtype=torch.float64) - tolerance).all()
    assert (states <= torch.tensor(high, dtype=torch.float64) + tolerance).all()
