"""Every dataclass of settings checks its own fields, whatever is written into them."""

from __future__ import annotations

import math
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from phihp_torchrl.agents import TD3Config
from phihp_torchrl.config import ConfigError, check_widths
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import PolicyConfig, RunConfig
from phihp_torchrl.trainers.exploration import ExplorationConfig
from phihp_torchrl.worlds import SimulatedConfig

from .test_typed import NEEDED, settings_classes

FIELDS = [
    (cls, f)
    for cls in settings_classes()
    for f in fields(cls)
    if f.init and f.type not in ("Any", "Mapping[str, Any]")  # others check these
]
NUMBERS = st.one_of(
    st.integers(-3, 3),
    st.sampled_from([10**9, 10**18, 10**400, -(10**9)]),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([math.nan, math.inf, -math.inf, -0.0, 1e-300, 1e300]),
    st.floats(width=32).map(np.float32),
    st.integers(-3, 10).map(np.int64),
    st.sampled_from([np.array(0.5), np.array(2), torch.tensor(0.5), torch.tensor(math.nan)]),
)
HOSTILE = st.recursive(
    st.one_of(
        NUMBERS,
        st.none(),
        st.booleans(),
        st.text(max_size=5),
        st.sampled_from(["auto", "none", "1 s", "-1 s", "1e999 s", "nan s", "0 ms", b"x"]),
        st.builds(object),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(inner, max_size=3).map(tuple),
        st.dictionaries(st.text(max_size=3), inner, max_size=2),
        st.just(np.ones(2)),
    ),
    max_leaves=4,
)


def made(cls: type, f: Field, value: Any) -> Any:
    return cls(**{**NEEDED.get(cls.__name__, {}), f.name: value})


def is_plain(value: Any) -> bool:
    """Whether a value is one that YAML has, with finite numbers, or settings of these."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_plain(item) for key, item in value.items())
    if isinstance(value, tuple):
        return all(map(is_plain, value))
    if isinstance(value, float):
        return type(value) is float and abs(value) <= 3.5e38
    return value is None or type(value) in (bool, int, str) or is_dataclass(value)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(FIELDS), HOSTILE)
def test_a_value_is_refused_by_name_or_is_plain_and_finite(chosen: tuple, value: Any) -> None:
    cls, f = chosen
    try:
        kept = getattr(made(cls, f, value), f.name)
    except ConfigError as error:
        assert error.reason.startswith(("expected", "unknown")), error  # noqa: PT017
        return
    assert is_plain(kept), (cls.__name__, f.name, kept)


@pytest.mark.parametrize(
    ("cls", "f"),
    [(cls, f) for cls, f in FIELDS if "float" in str(f.type)],
    ids=lambda value: getattr(value, "__name__", getattr(value, "name", None)),
)
def test_no_number_is_infinite_or_missing(cls: type, f: Field) -> None:
    infinite = () if "infinite" in f.metadata else (math.inf, -math.inf, 1e39)
    for value in (math.nan, *infinite):
        wrong = {"x": value} if "Mapping" in str(f.type) else value
        wrong = (value,) * 2 if str(f.type).startswith("tuple") else wrong
        with pytest.raises(ConfigError, match=rf"^{f.name}"):
            made(cls, f, wrong)


@pytest.mark.parametrize(
    ("cls", "f"),
    [(cls, f) for cls, f in FIELDS if "learning_rate" in f.name],
    ids=lambda value: getattr(value, "__name__", getattr(value, "name", None)),
)
@pytest.mark.parametrize("value", [0.0, -1e-3, 2.0])
def test_a_learning_rate_is_above_0_and_at_most_1(cls: type, f: Field, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"^{f.name}: expected a number in \(0, 1\]"):
        made(cls, f, value)


def test_numbers_of_numpy_and_torch_are_taken_as_plain_ones() -> None:
    config = TD3Config(tau=np.float32(0.5), policy_delay=np.int64(3), gamma=torch.tensor(0.5))
    assert (type(config.tau), type(config.policy_delay), type(config.gamma)) == (float, int, float)
    assert config == TD3Config(tau=0.5, policy_delay=3, gamma=0.5)


def test_a_list_is_taken_as_a_tuple_and_a_guard_may_have_one_side() -> None:
    assert TD3Config(actor_hidden_sizes=[8, 8]) == TD3Config(actor_hidden_sizes=(8, 8))
    one_sided = {"x": (-math.inf, 2.0)}
    assert ExplorationConfig(guards=one_sided).guards == one_sided


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CEMConfig(num_candidates=10**9), "num_candidates: expected optim_steps \\*"),
        (lambda: CEMConfig(planning_horizon=10**9, replan_every=1), "planning_horizon: expected"),
        (lambda: PolicyConfig(replay_capacity=10**12), "replay_capacity: expected replay_capacity"),
        (lambda: TD3Config(actor_hidden_sizes=(65_536,) * 3), "actor_hidden_sizes: expected 1 to"),
        (lambda: SimulatedConfig(substeps=10**9), "substeps: expected at most 1000"),
        (lambda: RunConfig("pendulum", threads=10**6), "threads: expected at most"),
        (lambda: RunConfig("pendulum", world="simulated"), "world: expected settings of a world"),
        (lambda: RunConfig("pendulum", sections={"model": {}}), "model: expected a ModelConfig"),
    ],
)
def test_what_no_memory_holds_and_no_section_is_gets_refused(make: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        make()


def test_every_class_of_settings_calls_the_check() -> None:
    """A class without numbers of its own is in no test above."""
    for cls in settings_classes():
        for f in fields(cls):
            needed = f.default is MISSING and f.default_factory is MISSING
            if needed and f.type == "str":
                with pytest.raises(ConfigError, match=f"^{f.name}: expected a text"):
                    made(cls, f, 3)


def test_widths_count_their_weights() -> None:
    class Sizes:
        few, many = (64,) * 32, (16_384, 16_385)

    check_widths(Sizes, "few")
    with pytest.raises(ConfigError, match=r"^many: expected"):
        check_widths(Sizes, "many")
