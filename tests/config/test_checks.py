"""Range checks of settings."""

from __future__ import annotations

import re
from math import inf, nan
from types import SimpleNamespace

import pytest

from phihp_torchrl.config import (
    ConfigError,
    check_choice,
    check_count,
    check_not_negative,
    check_positive,
    check_positive_share,
    check_share,
    check_widths,
    is_whole,
)

TINY = 1e-300  # not a subnormal: torch may flush those to zero


@pytest.mark.parametrize(
    ("check", "expected", "good", "bad"),
    [
        (check_positive, "a positive number", (1, TINY, 1e38), (0, -1, inf, nan, 1e39, "1", True)),
        (check_count, "a whole number >= 1", (1, 2, 10**9), (0, 0.5, 1.5, -1, inf, nan, True)),
        (check_not_negative, "a number >= 0", (0, 0.0, 1, 1e38), (-1, -TINY, inf, nan, 1e39, None)),
        (check_share, "a number in [0, 1]", (0, TINY, 0.5, 1), (-TINY, 1.01, 2, inf, nan)),
        (check_positive_share, "a number in (0, 1]", (TINY, 0.5, 1), (0, -TINY, 1.01, inf, nan)),
        (
            check_widths,
            "1 to 32 widths up to 65536",
            ((1,), [16, 16], (2048,) * 32, (65_536, 4096)),
            ((), (0,), (16, -1), (16.0,), (True,), (65_537,), (1,) * 33, 16, None, "16"),
        ),
    ],
)
def test_a_value_out_of_range_is_refused_by_its_name(check, expected, good, bad):
    for value in good:
        check(SimpleNamespace(key=value), "key")
    for value in bad:
        message = re.escape(f"key: expected {expected}, got {value!r}.")
        with pytest.raises(ConfigError, match=f"^{message}$"):
            check(SimpleNamespace(key=value), "key")


def test_the_first_of_several_is_named_and_the_others_are_left_alone():
    config = SimpleNamespace(first=1, second=0, third=-1, fourth=nan)
    check_positive(config)
    check_positive(config, "first")
    with pytest.raises(ConfigError, match=r"^second: expected a positive number, got 0\.$"):
        check_positive(config, "first", "second", "third")


@pytest.mark.parametrize("least", [0, 2])
def test_a_count_may_have_another_least(least):
    check_count(SimpleNamespace(key=least), "key", least=least)
    with pytest.raises(ConfigError, match=rf"^key: expected a whole number >= {least}, got "):
        check_count(SimpleNamespace(key=least - 1), "key", least=least)


def test_a_count_may_have_another_field_as_its_limit():
    check_count(SimpleNamespace(top_k=8, num_candidates=8), "top_k", most="num_candidates")
    with pytest.raises(ConfigError, match=r"^top_k: expected at most num_candidates = 8, got 9\.$"):
        check_count(SimpleNamespace(top_k=9, num_candidates=8), "top_k", most="num_candidates")


def test_a_choice_is_one_of_those_there_are():
    for value in ("mean", None, 3):
        check_choice(SimpleNamespace(select=value), "select", ("mean", None, 3))
    for value in ("Mean", "", 4, nan):
        message = re.escape(f"select: expected one of ['mean', None, 3], got {value!r}.")
        with pytest.raises(ConfigError, match=f"^{message}$"):
            check_choice(SimpleNamespace(select=value), "select", ("mean", None, 3))


def test_truth_values_are_no_whole_numbers():
    assert [is_whole(value, 0) for value in (0, 7, -1, True, False, 1.0, "1", None)] == [
        *(True, True),
        *[False] * 6,
    ]
