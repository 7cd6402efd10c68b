"""What fits from other first weights are worth: the table, from numbers made by hand."""

from __future__ import annotations

import math

import pytest

from phihp_torchrl.origin import describe_origin
from restarts import kept_rows, ratio, with_row, write_tables

ROWS = [
    {
        "task": "cartpole-swingup",
        "seed": seed,
        "restarts": 2,
        "once": 0.04,
        "best": best,
        "origin": describe_origin(seed),
    }
    for seed, best in ((20, 0.01), (21, 0.02), (22, 0.04))
]


def test_the_ratio_is_the_geometric_mean_with_its_interval():
    mean, low, high = ratio(ROWS)
    assert mean == pytest.approx(0.5)
    # Logarithms of 1/4, 1/2 and 1: a standard error of log 2 / sqrt(3), and t of 4.303.
    assert high / mean == pytest.approx(math.exp(4.303 * math.log(2) / 3**0.5), rel=1e-3)
    assert low * high == pytest.approx(mean**2)


def test_one_seed_has_no_interval():
    mean, low, high = ratio(ROWS[:1])
    assert mean == pytest.approx(0.25)
    assert math.isnan(low)
    assert math.isnan(high)


def test_the_table_says_what_was_compared(tmp_path):
    write_tables(ROWS, tmp_path)
    page = (tmp_path / "README.md").read_text()
    assert "| cartpole-swingup | 250 | 20 to 22 | 0.04 | 0.02 | 0.50 (" in page
    assert "Restarts: 2." in page
    assert kept_rows(tmp_path) == ROWS
    again = ROWS[1] | {"best": 0.03}
    assert with_row(ROWS, again) == [ROWS[0], again, ROWS[2]]
