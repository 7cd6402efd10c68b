"""The chosen way to plan on the fast budget."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from phihp_torchrl import load_config
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import (
    CalibratePhase,
)
from phihp_torchrl.trainers import calibrate as calibrate_module
from phihp_torchrl.trainers.calibrate_rule import Choice
from phihp_torchrl.trainers.calibrate_ways import faster

from .calibrate_parts import SMALL, TINY, finished, make_agent

WIDE = replace(SMALL, num_candidates=64)


def choose_the_first(ways, actor, **_):
    return Choice(next(iter(ways)), "planner", True, 1.0, 0.1)


@pytest.mark.parametrize("loses", [True, False])
def test_the_chosen_way_keeps_the_fast_budget_if_it_loses_nothing(monkeypatch, tmp_path, loses):
    monkeypatch.setattr(calibrate_module, "choose", choose_the_first)
    monkeypatch.setattr(calibrate_module, "loses_nothing", lambda cheap, plan, **_: not loses)
    phase = finished(make_agent(planner=WIDE), path=tmp_path / "table.json")
    table = json.loads((tmp_path / "table.json").read_text())
    assert table["budget"] == ("given" if loses else "fast")
    assert table["way"] == ("leaving" if loses else "fast")
    # What is left plays on alone.
    played = {name: way["episodes"] for name, way in table["ways"].items()}
    assert played == {"leaving": 6 if loses else 3, "fast": 3 if loses else 6}
    assert phase.planner_config.num_candidates == (64 if loses else 32)
    # It plays as the chosen way does.
    assert phase.planner_config.actor_margin == table["ways"]["leaving"]["changes"]["actor_margin"]
    assert phase.progress == (9, 9)


def test_a_fast_plan_that_is_behind_the_actor_does_not_act(monkeypatch):
    def choose(ways, actor, **_):
        name = next(iter(ways))
        return Choice(name, "actor" if name == "fast" else "planner", True, 1.0, 0.1)

    monkeypatch.setattr(calibrate_module, "choose", choose)
    monkeypatch.setattr(calibrate_module, "loses_nothing", lambda cheap, plan, **_: True)
    assert finished(make_agent(planner=WIDE)).acting == "actor"


@pytest.mark.parametrize(("gain", "planner"), [(0.0, WIDE), (1.0, SMALL)])
def test_where_nothing_is_gained_or_plans_are_cheap_none_is_played_faster(
    monkeypatch, gain, planner
):
    chosen = Choice("leaving", "planner", True, gain, 0.1 * gain)
    monkeypatch.setattr(calibrate_module, "choose", lambda ways, actor, **_: chosen)
    final = finished(make_agent(planner=planner)).final
    assert "fast" not in final["ways"]
    assert final["budget"] == "given"


def test_an_interrupted_phase_goes_on_with_the_fast_budget(monkeypatch):
    monkeypatch.setattr(calibrate_module, "choose", choose_the_first)
    agent = make_agent(planner=WIDE)
    begun, resumed = (CalibratePhase(agent, TINY, seed=0) for _ in range(2))
    while begun.chosen is None:
        begun.advance()
    resumed.load_state_dict(begun.state_dict())
    for phase in (begun, resumed):
        while not phase.done:
            phase.advance()
    assert resumed.final == begun.final
    assert "fast" in resumed.final["ways"]


def test_the_fast_way_is_as_small_as_the_fast_budget():
    budget = load_config("pendulum", overrides=["budget=fast"])["planner"]
    large = CEMConfig(99, optim_steps=99, num_candidates=999, top_k=99, num_policy_candidates=99)
    assert len(found := faster(large, {})) == 5
    assert found == {name: budget[name] for name in found}
