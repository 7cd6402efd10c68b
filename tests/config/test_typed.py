"""Typed settings: dataclasses out of plain mappings and back, faults named by dotted keys."""

from __future__ import annotations

import importlib
import json
import pkgutil
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass
from types import SimpleNamespace
from typing import Any, ClassVar, Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import phihp_torchrl
from phihp_torchrl.agents import TD3Config
from phihp_torchrl.config import (
    ConfigError,
    Registry,
    differences,
    flatten,
    from_mapping,
    kind_mapping,
    read_kind,
    to_mapping,
)
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.imagination import StartConfig
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import ModelConfig, RunConfig, read_run_config
from phihp_torchrl.worlds import SimulatedConfig


@dataclass(frozen=True)
class Inner:
    rate: float = 0.1
    pair: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Outer:
    name: Literal["a", "b"]
    inner: Inner = field(default_factory=Inner)
    size: int | None = None
    table: Mapping[str, float] = field(default_factory=dict)
    source: str | None = field(default=None, metadata={"key": "from"})

    def __post_init__(self) -> None:
        if self.size == 0:
            raise ConfigError("size", "expected a positive number, got 0.")


# A mapping and its dataclass


def test_a_mapping_becomes_dataclasses_and_back() -> None:
    mapping = {
        "name": "a",
        "inner": {"rate": 1.0, "pair": [1.0, 2.0]},
        "size": 3,
        "table": {"g": 9.8},
        "from": "here",
    }
    outer = from_mapping(Outer, mapping)
    assert outer == Outer("a", Inner(1.0, (1.0, 2.0)), 3, {"g": 9.8}, "here")
    assert to_mapping(outer) == mapping


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({}, "x.name: missing"),
        ({"name": "c"}, "x.name: expected one of"),
        ({"name": "a", "nane": 1}, "x.nane: unknown key; did you mean 'name'"),
        ({"name": "a", "zzz": 1}, "x.zzz: unknown key; expected one of"),
        ({"name": "a", "source": "here"}, "x.source: unknown key; expected one of ['from',"),
        ({"name": "a", "inner": {"rate": "fast"}}, "x.inner.rate: expected a number"),
        ({"name": "a", "inner": {"rate": True}}, "x.inner.rate: expected a number"),
        ({"name": "a", "inner": {"pair": [1]}}, "x.inner.pair: expected 2 values"),
        ({"name": "a", "inner": {"pair": [1, "x"]}}, "x.inner.pair[1]: expected a number"),
        ({"name": "a", "inner": 3}, "x.inner: expected keys and values"),
        ({"name": "a", "size": 0}, "x.size: expected a positive number"),
        ({"name": "a", "size": 1.5}, "x.size: expected a whole number"),
        ({"name": "a", "table": {"g": "x"}}, "x.table.g: expected a number"),
        (None, "x: expected keys and values"),
    ],
)
def test_conversion_names_the_key(mapping: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        from_mapping(Outer, mapping, "x")


def test_the_key_and_the_reason_of_a_fault_are_apart() -> None:
    with pytest.raises(ConfigError) as caught:
        from_mapping(Outer, {"name": "a", "inner": {"rate": None}}, "x")
    assert (caught.value.key, caught.value.reason) == (
        "x.inner.rate",
        "expected a number, got None.",
    )


# Every settings dataclass of the package


def settings_classes() -> list[type]:
    """All dataclasses ``...Config`` in the package."""
    found = set()
    for module in pkgutil.walk_packages(phihp_torchrl.__path__, "phihp_torchrl."):
        if module.name.endswith("__main__"):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if (
                isinstance(value, type)
                and is_dataclass(value)
                and value.__name__.endswith("Config")
            ):
                found.add(value)
    return sorted(found, key=lambda cls: cls.__name__)


NEEDED = {
    "GymnasiumConfig": {"id": "Pendulum-v1"},
    "RecordedConfig": {"files": "logs/*.csv"},
    "TorchRLConfig": {"make": "module:function"},
    "RunConfig": {"task": "pendulum"},
    "ExportConfig": {"agent": "somewhere"},
    "PlayConfig": {"agent": "somewhere"},
}
"""Settings that have no default."""


def test_the_settings_dataclasses_are_found() -> None:
    names = {cls.__name__ for cls in settings_classes()}
    assert names >= {"RunConfig", "ModelConfig", "TD3Config", "CEMConfig", "SimulatedConfig"}
    assert names >= NEEDED.keys()
    assert len(names) >= 24


@pytest.mark.parametrize("cls", settings_classes(), ids=lambda cls: cls.__name__)
def test_every_settings_dataclass_survives_yaml_and_json(cls: type) -> None:
    ours = cls(**NEEDED.get(cls.__name__, {}))
    read, plain = (
        (read_run_config, ours.to_mapping())
        if cls is RunConfig
        else (lambda mapping: from_mapping(cls, mapping), to_mapping(ours))
    )
    for there_and_back in (
        lambda mapping: mapping,
        lambda mapping: yaml.safe_load(yaml.safe_dump(mapping)),
        lambda mapping: json.loads(json.dumps(mapping)),
    ):
        assert read(there_and_back(plain)) == ours


counts = st.integers(1, 1000)
sizes = st.lists(st.integers(1, 8_192), min_size=1, max_size=4).map(tuple)
positive = st.floats(1e-12, 1e12)
shares = st.floats(0.0, 1.0)
positive_shares = st.floats(1e-6, 1.0)
constants = st.dictionaries(st.text(min_size=1), st.floats(-1e6, 1e6), max_size=3)


@st.composite
def cem_configs(draw: Any) -> CEMConfig:
    candidates = draw(st.integers(2, 500))
    top_k = draw(st.integers(1, candidates))
    horizon = draw(st.integers(1, 50))
    return CEMConfig(
        planning_horizon=horizon,
        optim_steps=draw(counts),
        num_candidates=candidates,
        top_k=top_k,
        num_policy_candidates=draw(st.integers(0, candidates - 1)),
        policy_noise=draw(shares),
        alpha=draw(positive),
        gamma=draw(shares),
        init_std=draw(positive),
        tail_dtype=draw(st.sampled_from(["float32", "bfloat16"])),
        num_kept_elites=draw(st.integers(0, top_k)),
        select=draw(st.sampled_from(["mean", "best"])),
        compare_with_actor=draw(st.booleans()),
        replan_every=draw(st.integers(1, horizon)),
        warm_start=draw(st.booleans()),
    )


ANY_SETTINGS = st.one_of(
    cem_configs(),
    st.builds(StartConfig, reset=positive, data=positive, coverage=shares, goal=shares),
    st.builds(
        TD3Config,
        actor_hidden_sizes=sizes,
        critic_hidden_sizes=sizes,
        actor_learning_rate=positive_shares,
        gamma=positive_shares,
        tau=positive_shares,
        policy_delay=counts,
        target_noise=positive,
        value_expansion=counts,
    ),
    st.builds(
        ModelConfig,
        real_steps=counts,
        steps_per_iteration=st.none() | counts,
        hidden_sizes=sizes,
        activation=st.sampled_from(["relu", "tanh", "silu"]),
        integrator=st.sampled_from(["semi_implicit_euler", "rk4"]),
        substeps=counts,
        warm_start=st.booleans(),
        fit=st.builds(
            FitConfig,
            method=st.sampled_from(["levenberg_marquardt", "adam"]),
            steps=counts,
            batch_size=st.none() | counts,
            learning_rate=positive_shares,
            scaled=st.booleans(),
        ),
    ),
    st.builds(
        SimulatedConfig,
        integrator=st.sampled_from(["semi_implicit_euler", "rk4"]),
        substeps=counts,
        constants=constants,
        friction=constants,
    ),
)


@given(ANY_SETTINGS)
def test_any_settings_come_back_from_their_mapping(ours: Any) -> None:
    plain = to_mapping(ours)
    assert from_mapping(type(ours), plain) == ours
    assert to_mapping(from_mapping(type(ours), json.loads(json.dumps(plain)))) == plain


@given(
    st.builds(
        RunConfig,
        task=st.just("pendulum"),
        seed=st.integers(0, 10_000),
        checkpoint_interval=shares,
        compile=st.booleans(),
        planner=cem_configs(),
        world=st.builds(SimulatedConfig, substeps=counts, constants=constants),
    )
)
def test_any_run_comes_back_from_its_mapping(ours: RunConfig) -> None:
    assert read_run_config(json.loads(json.dumps(ours.to_mapping()))) == ours


# Sections of one of several kinds


@dataclass(frozen=True)
class Red:
    kind: ClassVar[str] = "red"
    depth: int = 1


@dataclass(frozen=True)
class Blue:
    kind: ClassVar[str] = "blue"
    tint: str = "sky"


HUES: Registry[Any] = Registry("hue")
HUES.register("red", SimpleNamespace(config=Red))
HUES.register("blue", SimpleNamespace(config=Blue))


@dataclass(frozen=True)
class Wall:
    hue: Any = field(default_factory=Red, metadata={"kinds": HUES})


@pytest.mark.parametrize("hue", [Red(), Red(3), Blue(), Blue("sea"), None])
def test_a_section_says_of_which_kind_it_is(hue: Any) -> None:
    plain = to_mapping(Wall(hue))
    assert from_mapping(Wall, plain) == Wall(hue)
    if hue is not None:
        assert plain == {"hue": kind_mapping(hue)}
        assert plain["hue"]["kind"] == hue.kind
        assert read_kind(HUES, plain["hue"], "hue") == hue


def test_a_section_without_a_kind_is_of_the_first() -> None:
    assert read_kind(HUES, {"depth": 4}, "hue") == Red(4)
    assert read_kind(HUES, {"kind": None}, "hue") == Red()


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"kind": "green"}, "wall.hue.kind: expected one of ['blue', 'red'], got 'green'."),
        (
            {"kind": "bleu"},
            "wall.hue.kind: expected one of ['blue', 'red'], got 'bleu'; did you mean 'blue'?",
        ),
        ({"kind": "red", "tint": "sky"}, "wall.hue.tint: unknown key"),
        ({"tint": "sky"}, "wall.hue.tint: unknown key"),
        ({"kind": "blue", "tint": 3}, "wall.hue.tint: expected a text, got 3."),
        ("red", "wall.hue: expected keys and values, got 'red'."),
    ],
)
def test_what_is_wrong_in_a_section_is_named(section: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        from_mapping(Wall, {"hue": section}, "wall")


# Plain mappings


def test_differences_are_named() -> None:
    ours = {"a": {"b": 1, "c": 2}, "d": 3}
    assert differences(ours, ours) == []
    assert differences(ours, {"a": {"b": 1, "c": 4}, "e": 5}) == [
        ("a.c", 2, 4),
        ("d", 3, None),
        ("e", None, 5),
    ]


leaves = st.none() | st.booleans() | st.integers() | st.text()
plain_keys = st.text("abc", min_size=1, max_size=2)
mappings = st.recursive(
    st.dictionaries(plain_keys, leaves, max_size=3),
    lambda inner: st.dictionaries(plain_keys, leaves | inner, max_size=3),
    max_leaves=8,
)


@given(mappings)
def test_flattening_loses_nothing(mapping: dict[str, Any]) -> None:
    nested: dict[str, Any] = {}
    for name, value in flatten(mapping).items():
        *path, last = name.split(".")
        section = nested
        for key in path:
            section = section.setdefault(key, {})
        section[last] = value
    assert nested == mapping


@given(mappings, mappings)
def test_differences_are_symmetric_and_are_differences(ours: Any, theirs: Any) -> None:
    assert differences(ours, ours) == []
    found = {name: (a, b) for name, a, b in differences(ours, theirs)}
    assert found == {name: (b, a) for name, a, b in differences(theirs, ours)}
    assert all(a != b for a, b in found.values())
