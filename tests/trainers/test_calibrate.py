"""Calibration in imagination: its phase, its choice, and what the agent's file says."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import load_agent, load_config, save_agent
from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import (
    CalibrateConfig,
    CalibratePhase,
    calibrate_contest,
    read_run_config,
    run,
)
from phihp_torchrl.trainers import calibrate as calibrate_module
from phihp_torchrl.trainers.calibrate_report import report, summary
from phihp_torchrl.trainers.calibrate_rule import Choice, Way
from phihp_torchrl.trainers.imagined_play import play

from .calibrate_parts import SMALL, TINY, finished, make_agent
from .run_parts import CONFIG, with_sections


@pytest.mark.usefixtures("restless")
def test_a_plan_that_beats_a_poor_actor_acts(tmp_path):
    """The actor is untrained; the plan looks ahead."""
    planner = replace(SMALL, planning_horizon=8, num_candidates=64)
    config = replace(TINY, confidence=0.0)
    phase = finished(make_agent(planner=planner), config, path=tmp_path / "table.json")
    table = json.loads((tmp_path / "table.json").read_text())
    assert phase.acting == table["acting"] == "planner"
    assert table["planner_return"] > table["actor_return"]
    assert table["gain"] > 0
    assert list(table["ways"])[:2] == ["given", "still"]
    assert table["ways"][table["way"]]["gain"] == table["gain"]
    assert phase.parts()["planner_config"] == phase.planner_config
    assert phase.progress[0] == phase.progress[1]


def test_where_no_plan_is_better_the_actor_acts():
    """One that never leaves the actor's sequence has a gain of exactly zero."""
    same = replace(SMALL, num_candidates=2, top_k=1, policy_noise=0.0)
    phase = finished(make_agent(planner=same))
    assert phase.final["gain"] == 0.0
    assert phase.final["certain"] is True
    assert phase.final["episodes"] == TINY.episodes  # no more are needed
    assert phase.parts()["use_planner"] is False
    assert phase.parts()["metadata"]["acting"] == "actor"


@pytest.mark.usefixtures("restless")
def test_the_same_seed_chooses_the_same_wherever_it_is_interrupted():
    agent, config = make_agent(), replace(TINY, confidence=1e6)
    before = torch.random.get_rng_state()
    begun = CalibratePhase(agent, config, seed=0)
    for _ in range(3):  # into the second lot
        begun.advance()
    resumed = CalibratePhase(agent, config, seed=0)
    resumed.load_state_dict(begun.state_dict())
    assert resumed.progress == begun.progress
    for phase in (begun, resumed):
        while not phase.done:
            phase.advance()
    assert resumed.state_dict() == begun.state_dict()
    assert torch.equal(before, torch.random.get_rng_state())  # the noise is its own


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"enabled": 1}, "enabled: expected true or false, got 1"),
        ({"episodes": 1}, "episodes: expected a whole number >= 2, got 1"),
        ({"confidence": -1.0}, "confidence: expected a number >= 0"),
        ({"max_episodes": 5}, "max_episodes: expected a whole number >= 6, got 5"),
        ({"budget": 0}, "budget: expected a .*whole number.*, got 0"),
    ],
)
def test_wrong_settings_are_refused_by_name(wrong, message):
    with pytest.raises(ConfigError, match=message):
        CalibrateConfig(**wrong)


@pytest.mark.usefixtures("restless")
def test_in_doubt_more_episodes_are_played_up_to_the_limit(caplog):
    """No gain is above so many standard errors."""
    phase = finished(make_agent(), replace(TINY, confidence=1e6))
    assert phase.final["episodes"] == TINY.max_episodes
    assert phase.final["certain"] is False
    assert "Raise calibrate.max_episodes" in caplog.text
    # Only the chosen way has played on, and its lots are from different starts.
    for name, (returns, _) in phase.contest._played.items():
        chosen = name == phase.final["way"]
        assert len(set(returns)) == (TINY.max_episodes if chosen else TINY.episodes)


def test_episodes_are_whole_and_chatter_is_that_of_their_second_half():
    phase = finished(make_agent())
    steps, of = phase.agent.task.max_steps, phase.final
    actor = phase.agent.actor_alone()
    played = play(actor, phase.contest.world_model, phase.contest.starts[: of["episodes"]])
    assert len(played.changes) == steps
    assert of["actor_return"] == pytest.approx(played.total.mean().item(), rel=1e-5)
    late = played.changes[steps // 2 :].mean().item()
    assert of["actor_chatter"] == pytest.approx(late, rel=1e-4)


def test_a_plan_that_fails_late_does_not_act(monkeypatch):
    """What a plan spoils at the end of its episodes counts."""

    def spoilt(agent, *arguments, **options):
        played = play(agent, *arguments, **options)
        return played if agent.planner is None else played._replace(total=played.total - 100.0)

    monkeypatch.setattr(calibrate_contest, "play", spoilt)
    phase = finished(make_agent())
    assert phase.acting == "actor"
    assert phase.final["certain"] is True


@pytest.mark.usefixtures("restless")
@pytest.mark.parametrize("taken", ["still", "mild", "nothing"])
def test_the_first_calm_way_that_is_taken_is_the_last_that_plays(monkeypatch, taken):
    names = ["given", "still", "calm", "mild", "loose"]

    def choose(ways, actor, **_):
        name = taken if taken in ways else "given"
        return Choice(name, "planner", True, 1.0, 0.1)

    monkeypatch.setattr(calibrate_module, "choose", choose)
    ways = list(finished(make_agent()).final["ways"])
    assert ways == (names[: names.index(taken) + 1] if taken in names else names)


def test_a_gain_in_a_few_episodes_is_not_certain_yet(monkeypatch):
    """Three may say anything."""
    sure = Choice("leaving", "planner", True, 1.0, 0.1)
    monkeypatch.setattr(calibrate_module, "choose", lambda ways, actor, **_: sure)
    config = replace(TINY, max_episodes=48)
    assert finished(make_agent(), config).final["episodes"] == 24
    poor = finished(make_agent(), replace(config, budget=1)).final
    assert (poor["episodes"], poor["certain"]) == (6, False)
    same = sure._replace(acting="actor", gain=0.0, gain_error=0.0)
    monkeypatch.setattr(calibrate_module, "choose", lambda ways, actor, **_: same)
    assert finished(make_agent(), config).final["episodes"] == 3


def test_an_actor_that_rests_is_left_alone():
    """A plan gains where the actor is poor, and has no say where it rests."""
    phase = finished(make_agent())
    assert phase.final["actor_chatter"] <= 0.02
    assert next(iter(phase.final["ways"])) == "leaving"
    assert phase.planner_config.actor_margin > 0.0


@pytest.mark.parametrize("taken", ["given", "leaving"])
def test_where_plans_promise_much_beyond_an_actor_that_rests_all_ways_may_play(monkeypatch, taken):
    def choose(ways, actor, **_):
        return Choice(taken if taken in ways else "given", "planner", False, 1.0, 0.6)

    monkeypatch.setattr(calibrate_module, "_LITTLE", 0.0)
    monkeypatch.setattr(calibrate_module, "choose", choose)
    ways = list(finished(make_agent()).final["ways"])
    assert ways[:3] == ["given", "leaving", "priced"]
    assert "still" in ways


def test_where_models_disagree_the_settings_stay_as_given(caplog):
    """The other model's pendulum is much lighter."""
    agent = make_agent()
    other = copy.deepcopy(agent.dynamics)
    with torch.no_grad():
        other.prior.log_constants.sub_(1.4)
    phase = finished(agent, others=[other])
    assert list(phase.final["ways"]) == ["given"]
    assert phase.final["changes"] == {}
    assert phase.final["models_disagree"] is True
    (elsewhere,) = phase.final["actor_elsewhere"]
    assert elsewhere != pytest.approx(phase.final["actor_return"], rel=0.02)
    assert "stay as given" in caplog.text
    assert "model.real_steps" in caplog.text
    going_on = CalibratePhase(agent, TINY, seed=0, others=[other])
    going_on.load_state_dict(phase.state_dict())
    assert (going_on.elsewhere, going_on.doubted) == ([elsewhere], True)


def test_models_that_agree_change_nothing(caplog):
    agent = make_agent()
    alone, among = finished(agent), finished(agent, others=[copy.deepcopy(agent.dynamics)])
    assert among.final["ways"] == alone.final["ways"]
    assert among.final["models_disagree"] is False
    assert "stay as given" not in caplog.text


@pytest.mark.parametrize("acting", ["actor", "planner"])
def test_the_file_says_how_the_agent_acts(tmp_path, acting):
    agent = make_agent()
    save_agent(agent, tmp_path, metadata={"acting": acting})
    loaded = load_agent(tmp_path)
    assert (loaded.planner is None) == (acting == "actor")
    assert loaded.planner_config == SMALL
    assert load_agent(tmp_path, planner=True).planner is not None
    seen = TensorDict(observation=torch.tensor([[1.0, 0.0, 0.0]]), batch_size=[1])
    assert loaded(seen)["action"].shape == (1, 1)


@pytest.mark.slow
def test_a_run_calibrates_before_it_evaluates(tmp_path):
    assert read_run_config(load_config("pendulum")).section("calibrate").enabled
    config = with_sections(CONFIG, calibrate=TINY)
    result = run(config, tmp_path / "run")
    table = json.loads((tmp_path / "run" / "calibration.json").read_text())
    agent = load_agent(tmp_path / "run" / "agent")
    assert agent.metadata["acting"] == table["acting"]
    evaluated = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert ("planner" in evaluated) == (table["acting"] == "planner")
    assert result.metrics["calibrate/acting_planner"] == float(table["acting"] == "planner")


@pytest.mark.parametrize(
    ("gain_error", "words"), [(5.0, "a rare failure may be missed in 6"), (300.0, "is in doubt")]
)
def test_a_doubt_says_which_it_is(gain_error, words, caplog):
    ways = {"given": Way((400.0, 500.0), (0.1, 0.1))}
    choice = Choice("given", "planner", False, 450.0, gain_error)
    report(summary(choice, ways, Way((0.0,) * 6, (0.1,) * 6)))
    assert words in caplog.text
    assert "planner acts" in caplog.text
