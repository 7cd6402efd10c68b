"""Seconds in the place of steps: texts, their resolution, and what refuses them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import pytest

from phihp_torchrl.agents import AnalyticConfig, RefitConfig, TD3Config
from phihp_torchrl.config import (
    ConfigError,
    Discount,
    Steps,
    check_discount,
    check_steps,
    discount_of,
    from_mapping,
    parse_seconds,
    refuse_seconds,
    resolve_seconds,
    steps_in,
    to_mapping,
)
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.tdmpc import TDMPCTrainConfig
from phihp_torchrl.trainers import CollectConfig, PolicyConfig


@dataclass(frozen=True)
class Inner:
    horizon: Steps = 3


@dataclass(frozen=True)
class Outer:
    age: Steps | None = None
    gamma: Discount = 0.9
    label: str = "5 s"
    inner: Inner = Inner()

    def __post_init__(self) -> None:
        if self.age is not None:
            check_steps(self, "age")
        check_discount(self, "gamma")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("1.5 s", 1.5), ("1.5s", 1.5), (" 2 s ", 2.0), (".5 s", 0.5), ("40 ms", 0.04), ("1e1 s", 10)],
)
def test_texts_of_seconds(text: str, seconds: float) -> None:
    assert parse_seconds(text) == pytest.approx(seconds, rel=1e-12)


@pytest.mark.parametrize("text", ["", "s", "5", "-1 s", "0 s", "1 min", "1e999 s", "1,5 s"])
def test_texts_that_are_no_duration(text: str) -> None:
    with pytest.raises(ConfigError, match="a duration such as"):
        parse_seconds(text)


def test_steps_are_rounded_to_the_nearest() -> None:
    assert [steps_in(f"{tenths / 10} s", 0.2) for tenths in (1, 2, 3, 4, 5)] == [1, 1, 2, 2, 3]
    # 0.3 / 0.04 is a rounding error below seven and a half
    assert steps_in("0.3 s", 0.04) == 8


def test_less_than_half_a_step_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"at least a step of 0\.05 s, got '0\.02 s'"):
        steps_in("0.02 s", 0.05)


def test_a_time_constant_of_less_than_a_step_is_refused() -> None:
    assert discount_of("0.04 s", 0.04) == pytest.approx(math.exp(-1.0))
    with pytest.raises(ConfigError, match=r"at least a step of 0.04 s, got '1 ms'"):
        discount_of("1 ms", 0.04)
    with pytest.raises(ConfigError) as error:
        resolve_seconds(PolicyConfig(td3=TD3Config(gamma="30 ms")), 0.04)
    assert error.value.key == "td3.gamma"


def test_a_discount_by_its_time_constant_means_the_same_at_every_time_step() -> None:
    for step in (0.01, 0.02, 0.05):
        assert discount_of("3 s", step) ** round(3 / step) == pytest.approx(math.exp(-1))


def test_resolving_reaches_sections_and_leaves_other_texts() -> None:
    written = from_mapping(
        Outer, {"age": "2 s", "gamma": "1 s", "inner": {"horizon": "0.5 s"}}, "outer"
    )
    assert to_mapping(written)["inner"] == {"horizon": "0.5 s"}
    resolved = resolve_seconds(written, 0.1)
    assert resolved == Outer(20, math.exp(-0.1), "5 s", Inner(5))


def test_numbers_stay_as_they_are() -> None:
    config = PolicyConfig()
    assert resolve_seconds(config, 0.02) is config


def test_errors_of_resolution_have_the_dotted_name() -> None:
    with pytest.raises(ConfigError) as raised:
        resolve_seconds(Outer(inner=Inner("0.01 s")), 0.1)  # type: ignore[arg-type]
    assert raised.value.key == "inner.horizon"


@pytest.mark.parametrize("value", [0, -1, 1.5, True, None, "0 s", "3", "soon"])
def test_steps_that_are_refused(value: Any) -> None:
    with pytest.raises(ConfigError, match="or seconds such as"):
        check_steps(Inner(value), "horizon")


@pytest.mark.parametrize("value", [0.0, 1.1, -0.5, math.nan, True, "0 s", "0.9"])
def test_discounts_that_are_refused(value: Any) -> None:
    with pytest.raises(ConfigError, match="or a time constant such as"):
        Outer(gamma=value)


def test_settings_that_must_fit_each_other_are_checked_once_they_are_known() -> None:
    config = CEMConfig(planning_horizon="0.1 s", replan_every="0.2 s")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="replan_every: expected at most planning_horizon = 2"):
        resolve_seconds(config, 0.05)


IN_SECONDS = {
    TD3Config: ("gamma", "value_expansion"),
    RefitConfig: ("horizon",),
    AnalyticConfig: ("horizon",),
    PolicyConfig: ("max_age", "evaluation_steps"),
    CollectConfig: ("planning_horizon", "replan_every", "random_hold"),
    CEMConfig: ("planning_horizon", "replan_every", "gamma"),
    MPPIConfig: ("planning_horizon", "gamma"),
    TDMPCTrainConfig: ("horizon",),
}


@pytest.mark.parametrize("cls", list(IN_SECONDS))
def test_these_settings_may_be_given_in_seconds(cls: type[Any]) -> None:
    names = IN_SECONDS[cls]
    written = from_mapping(cls, dict.fromkeys(names, "0.4 s"), "section")
    with pytest.raises(ConfigError, match="no time step is known"):
        refuse_seconds(written)
    resolved = resolve_seconds(written, 0.1)
    for name in names:
        expected = math.exp(-0.25) if name == "gamma" else 4
        assert getattr(resolved, name) == pytest.approx(expected)
    default = cls()
    kept = {name: getattr(default, name) for name in names}
    assert replace(resolved, **kept) == default
    refuse_seconds(resolved)
