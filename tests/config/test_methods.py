"""Methods as data: what each is made of, and what may be registered."""

from __future__ import annotations

import re
from typing import Any

import pytest

from phihp_torchrl import load_config
from phihp_torchrl.config import METHODS, ConfigError, Method, flatten, get_method, register_method

PAPERS = [
    "phihp",
    "td3-im-ph",
    "td3-im-dd",
    "td3",
    "td-mpc",
    "cem-oracle",
    "ph-cem",
    "dd-cem",
    "ph-td-mpc-star",
    "td-mpc-star",
]


@pytest.fixture
def methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """The registry, which a test leaves as it was."""
    monkeypatch.setattr(METHODS, "_entries", dict(METHODS))


def test_the_papers_methods_are_registered_in_their_order() -> None:
    assert [name for name in METHODS if name in PAPERS] == PAPERS
    labels = {name: METHODS[name].label for name in PAPERS}
    assert len(set(labels.values())) == len(PAPERS)
    assert labels["phihp"] == "PhIHP"
    assert labels["td-mpc-star"] == "TD-MPC*"


@pytest.mark.parametrize("name", PAPERS)
def test_a_method_composes_to_what_it_says(name: str) -> None:
    method = get_method(name)
    settings = flatten(load_config(method=name))
    assert settings["method"] == name
    for key, value in flatten(method.settings).items():
        assert settings[key] == value, key
    if method.samples_key is not None:
        assert method.samples_key in settings
        assert method.samples_key.split(".")[0] in method.sections


def test_sections_are_the_phases_and_the_planner_of_those_that_plan() -> None:
    assert get_method("phihp").sections == ("model", "policy", "calibrate", "evaluate", "planner")
    assert get_method("td3").sections == ("td3", "evaluate")
    assert get_method("td-mpc").sections == ("tdmpc", "evaluate")
    assert [name for name in PAPERS if not get_method(name).plans] == [
        "td3-im-ph",
        "td3-im-dd",
        "td3",
        "td-mpc",
    ]


def test_a_models_kind_is_among_the_settings_and_changes_are_left_alone() -> None:
    method = get_method("cem-oracle")
    assert method.settings["model"] == {"kind": "oracle", "real_steps": 0}
    assert method.changes["model"] == {"real_steps": 0}
    assert get_method("phihp").settings == {}


@pytest.mark.usefixtures("methods")
def test_a_method_of_ones_own_composes_by_its_name() -> None:
    changes: dict[str, Any] = {"planner": {"planning_horizon": 12}}
    mine = Method("Mine", "mine", ("model", "evaluate"), model_kind="prior", changes=changes)
    assert register_method("mine-for-this-test", mine) is mine
    settings = load_config(method="mine-for-this-test")
    assert settings["model"]["kind"] == "prior"
    assert settings["planner"]["planning_horizon"] == 12
    with pytest.raises(ConfigError, match=r"^method: 'mine-for-this-test' is registered already"):
        register_method("mine-for-this-test", mine)
    other = Method("Other", "other", ("model", "evaluate"))
    register_method("mine-for-this-test", other, replace=True)
    assert get_method("mine-for-this-test") is other
    assert load_config(method="mine-for-this-test")["model"]["kind"] == "hybrid"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"phases": ()}, "phases: expected at least one, got none."),
        ({"acting": "sleeping"}, "acting: expected one of ['hybrid_planner', 'plain_planner', "),
        ({"group": "theirs"}, "group: expected one of ['ours', 'baseline', "),
    ],
)
def test_what_is_wrong_with_a_method_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        Method(**{"label": "x", "about": "y", "phases": ("model",), **options})


def test_an_unknown_method_is_refused_with_those_there_are() -> None:
    with pytest.raises(
        ConfigError, match=r"^method: expected one of \['cem-oracle', .*'phip'; did"
    ):
        get_method("phip")
