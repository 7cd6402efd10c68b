"""Range checks of configurations."""

from __future__ import annotations

import re
from math import inf, nan
from types import SimpleNamespace

import pytest

from phihp_torchrl.ranges import (
    check_count,
    check_not_negative,
    check_positive,
    check_positive_share,
    check_share,
)

TINY = 1e-300  # not a subnormal: torch may flush those to zero


@pytest.mark.parametrize(
    ("check", "expected", "good", "bad"),
    [
        (check_positive, "a positive number", (1, TINY, inf), (0, 0.0, -1, -inf, nan)),
        (check_count, "a positive number", (1, 2, 1.5, inf), (0, 0.5, -1, -inf, nan)),
        (check_not_negative, "a number >= 0", (0, 0.0, 1, inf), (-1, -TINY, -inf, nan)),
        (check_share, "a number in [0, 1]", (0, TINY, 0.5, 1), (-TINY, 1.01, 2, inf, nan)),
        (check_positive_share, "a number in (0, 1]", (TINY, 0.5, 1), (0, -TINY, 1.01, inf, nan)),
    ],
)
def test_a_value_out_of_range_is_refused_by_its_name(check, expected, good, bad):
    for value in good:
        check(SimpleNamespace(key=value), "key")
    for value in bad:
        message = re.escape(f"key: expected {expected}, got {value}.")
        with pytest.raises(ValueError, match=f"^{message}$"):
            check(SimpleNamespace(key=value), "key")


def test_the_first_of_several_is_named_and_the_others_are_left_alone():
    config = SimpleNamespace(first=1, second=0, third=-1, fourth=nan)
    check_positive(config)
    check_positive(config, "first")
    with pytest.raises(ValueError, match=r"^second: expected a positive number, got 0\.$"):
        check_positive(config, "first", "second", "third")
