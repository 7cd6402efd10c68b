"""A registry: entries by name, in their order, and errors that say what there is."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl.config import ConfigError, Registry

names = st.lists(st.text(min_size=1), unique=True)


@given(names)
def test_what_is_registered_is_found_in_its_order(given_names):
    registry = Registry("hue")
    for number, name in enumerate(given_names):
        assert registry.register(name, number) == number
    assert list(registry) == given_names
    assert len(registry) == len(given_names)
    assert dict(registry) == {name: registry.find(name) for name in given_names}
    assert [registry[name] for name in given_names] == list(range(len(given_names)))


@given(names, st.text(min_size=1))
def test_what_is_not_registered_is_refused_with_all_that_is(given_names, other):
    registry = Registry("hue")
    for name in set(given_names) - {other}:
        registry.register(name, name)
    assert other not in registry
    with pytest.raises(ConfigError) as caught:
        registry.find(other)
    assert caught.value.key == "hue"
    expected = f"expected one of {sorted(set(given_names) - {other})}, got {other!r}"
    assert caught.value.reason.startswith(expected)


def test_a_near_miss_is_told():
    registry = Registry("task")
    registry.register("pendulum", 1)
    with pytest.raises(ConfigError, match=r"^task: .*got 'pendulun'; did you mean 'pendulum'\?$"):
        registry.find("pendulun")
    with pytest.raises(ConfigError, match=r"got 'zzz'\.$"):
        registry.find("zzz")


def test_a_name_is_taken_until_it_is_replaced():
    registry = Registry("task")
    registry.register("a", 1)
    registry.register("b", 2)
    with pytest.raises(ConfigError, match=r"^task: 'a' is registered already; pass replace=True"):
        registry.register("a", 3)
    assert registry.find("a") == 1
    registry.register("a", 3, replace=True)
    assert dict(registry) == {"a": 3, "b": 2}
    assert list(registry) == ["a", "b"]


@pytest.mark.parametrize("name", [[0], {"x": 1.0}, None, 3, float("nan")])
def test_what_is_no_text_names_nothing(name):
    registry = Registry("hue")
    registry.register("r", 1)
    assert name not in registry
    with pytest.raises(ConfigError, match=r"^hue: expected one of \['r'\], got "):
        registry.find(name)
