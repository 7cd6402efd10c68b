"""Calibration in imagination: its grid, its choice, its phase, and what the agent's file says."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, HybridDynamics, get_task, load_agent, load_config, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.trainers import CalibrateConfig, CalibratePhase, read_run_config, run
from phihp_torchrl.trainers.calibrate_budget import Price, final_steps, fit_rounds
from phihp_torchrl.trainers.calibrate_choice import Trial, grid, rank
from phihp_torchrl.trainers.calibrate_rule import late_weight

from .run_parts import CONFIG, with_sections

SMALL = CEMConfig(
    planning_horizon=3, optim_steps=1, num_candidates=32, top_k=4, num_policy_candidates=2
)
TINY = CalibrateConfig(enabled=True, episodes=3, rounds=(3, 6), follow_steps=4, max_episodes=6)


def make_agent(name="brief-pendulum", planner=SMALL, last_layer=1.0):
    torch.manual_seed(0)
    task = get_task(name)
    actor = Actor(task)
    with torch.no_grad():
        list(actor.parameters())[-1].mul_(last_layer)
    return Agent(task, dynamics=HybridDynamics.hybrid(task), actor=actor, planner_config=planner)


def finished(agent, config=TINY, seed=0, path=None):
    phase = CalibratePhase(agent, config, seed=seed, path=path)
    while not phase.done:
        phase.advance()
    return phase


# The grid and the choice.


def test_the_grid_starts_with_the_settings_as_given_and_repeats_none():
    settings = grid(CEMConfig(), 1.234, 0.5)
    assert settings[0] == {}
    assert {"actor_margin": 2.5} in settings
    calm = {"change_cost": 0.5, "noise_beta": 2.0, "warm_start": True, "keep_incumbent": True}
    assert {**calm, "init_std": 0.1} in settings
    assert {**calm, "init_std": 0.1, "actor_margin": 2.5} in settings
    for changes in settings:
        replace(CEMConfig(), **changes)
        assert settings.count(changes) == 1
    assert len(grid(CEMConfig(), 0.0, 0.0)) < len(settings)


def test_a_planner_is_asked_only_for_what_it_has():
    settings = grid(MPPIConfig(), 1.0, 1.0)
    assert {key for changes in settings for key in changes} == {
        "change_cost",
        "noise_beta",
        "alpha",
        "planning_horizon",
        "init_std",
    }


def test_where_plans_promise_nothing_there_is_no_margin_to_try():
    settings = grid(CEMConfig(), 1e-4, 0.5)
    assert not any("actor_margin" in changes for changes in settings)
    narrow = grid(replace(CEMConfig(), init_std=0.05), 1.0, 0.5)
    assert all(changes.get("init_std", 0.05) == 0.05 for changes in narrow)


def trial(mean, spread, chatter, name):
    early = tuple(mean + spread * e for e in (-1.0, 0.0, 1.0))
    return Trial({"alpha": name}, 3, (early, (0.0, 0.0, 0.0)), chatter)


def test_within_the_noise_of_the_best_the_smoothest_comes_first():
    best, close, far = trial(2.0, 1.0, 0.4, 1), trial(1.6, 1.0, 0.01, 2), trial(1.0, 1.0, 0.0, 3)
    assert rank([far, best, close]) == [close, best, far]


def test_a_setting_whose_return_is_not_finite_comes_last():
    bad = Trial({"alpha": 1}, 3, ((math.nan, 1.0), (0.0, 0.0)), 0.0)
    good = Trial({"alpha": 2}, 3, ((-5.0, -5.0), (0.0, 0.0)), 1.0)
    assert rank([bad, good]) == [good, bad]


# The phase.


def test_a_plan_that_beats_a_poor_actor_acts(tmp_path):
    """The actor is untrained; the plan looks ahead."""
    planner = replace(SMALL, planning_horizon=8, num_candidates=64)
    config = replace(TINY, confidence=0.0)
    phase = finished(make_agent(planner=planner), config, path=tmp_path / "table.json")
    table = json.loads((tmp_path / "table.json").read_text())
    assert phase.acting == table["acting"] == "planner"
    assert table["planner_return"] > table["actor_return"]
    assert table["gain"] > 0
    first, second = (
        [row for row in table["trials"] if row["steps"] == steps] for steps in TINY.rounds
    )
    assert len(second) == (len(first) + 1) // 2
    changes = [row["changes"] for row in first]
    assert all(row["changes"] in changes for row in second)
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


def test_the_same_seed_chooses_the_same_wherever_it_is_interrupted():
    agent, config = make_agent(), replace(TINY, rounds=(2, 3), follow_steps=1)
    before = torch.random.get_rng_state()
    begun = CalibratePhase(agent, config, seed=0)
    for _ in range(13):  # into the second round, whose players have played before
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
        ({"rounds": ()}, "rounds: expected rising whole numbers >= 2"),
        ({"rounds": (4, 4)}, "rounds: expected rising whole numbers >= 2"),
        ({"confidence": -1.0}, "confidence: expected a number >= 0"),
        ({"max_episodes": 5}, "max_episodes: expected a whole number >= 6, got 5"),
        ({"budget": 0}, "budget: expected a .*whole number.*, got 0"),
    ],
)
def test_wrong_settings_are_refused_by_name(wrong, message):
    with pytest.raises(ConfigError, match=message):
        CalibrateConfig(**wrong)


def test_in_doubt_more_episodes_are_played_up_to_the_limit(caplog):
    """No gain is above so many standard errors."""
    phase = finished(make_agent(), replace(TINY, confidence=1e6))
    assert phase.final["episodes"] == TINY.max_episodes
    assert [lot["episodes"] for lot in phase.end.lots] == [3, 3]
    assert phase.final["certain"] is False
    assert "Raise calibrate.max_episodes" in caplog.text
    gain, error = phase.final["gain"], phase.final["gain_error"]
    assert (phase.acting == "planner") == (gain > -error)
    # The lots are from different starts.
    assert len(set(phase.end.finalists()["actor"].returns)) == TINY.max_episodes


def test_the_budget_ends_doubt_and_shortens_plans():
    small = finished(make_agent(), replace(TINY, confidence=1e6, budget=100_000))
    assert small.final["episodes"] == TINY.episodes
    assert small.final["steps"] == small._steps[-1]


def test_the_first_episodes_at_the_end_take_a_quarter_of_what_is_left():
    price = Price(SMALL)
    step = 2 * price.plan(2 * TINY.episodes)  # two plans, from two sorts of starts
    assert step == 2 * 3 * (1000 + 6 * 32)

    def steps(paid):
        return final_steps(TINY, price, rest=paid * step, least=3, longest=100)

    assert [steps(paid) for paid in (1e6, 200, 80, 40, 10, 0)] == [100, 50, 20, 16, 10, 3]


def test_dear_plans_have_fewer_episodes_and_then_fewer_steps():
    steps, episodes = fit_rounds(TINY, Price(SMALL), 9)
    assert (steps, episodes) == (TINY.rounds, TINY.episodes)
    dear = Price(SMALL, actor=1e4)
    steps, episodes = fit_rounds(replace(TINY, episodes=6), dear, 9)
    assert episodes == 3
    assert list(steps) == sorted(set(steps))
    assert steps[-1] < TINY.rounds[-1]


def test_larger_networks_make_plans_dearer():
    narrow = Price.of(make_agent())
    assert narrow.critics == 0.0  # it has none
    assert narrow.actor > 1.0
    assert narrow.plan(6) > Price(SMALL).plan(6)


def test_late_stretches_count_and_chatter_is_theirs():
    """A calm plan in another's place: the numbers of the end are those of both sorts of starts."""
    phase = finished(make_agent())
    of = phase.end.finalists()
    for way in of.values():
        assert len(way.returns) == len(way.late) == len(way.chatter) == phase.end.episodes
    gains = [
        [
            ours - theirs
            for ours, theirs in zip(
                getattr(of["given"], rows), getattr(of["actor"], rows), strict=True
            )
        ]
        for rows in ("returns", "late")
    ]
    weight = late_weight(torch.tensor(gains), of["given"].weight)
    assert 1.0 <= weight <= of["given"].weight
    ahead, error = of["given"].ahead_of(of["actor"])
    assert ahead == pytest.approx(
        (sum(gains[0]) + weight * sum(gains[1])) / phase.end.episodes, rel=1e-4
    )
    assert error > 0


# The agent that is shipped.


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
