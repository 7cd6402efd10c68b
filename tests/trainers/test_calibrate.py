"""Calibration in imagination: its grid, its choice, its phase, and what the agent's file says."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, HybridDynamics, get_task, load_agent, load_config, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.config import ConfigError
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.trainers import (
    CalibrateConfig,
    CalibratePhase,
    calibrate_contest,
    read_run_config,
    run,
)
from phihp_torchrl.trainers import calibrate as calibrate_module
from phihp_torchrl.trainers.calibrate_budget import Price, first_episodes
from phihp_torchrl.trainers.calibrate_rule import Choice
from phihp_torchrl.trainers.calibrate_ways import calmer, faster, leaving
from phihp_torchrl.trainers.imagined_play import play

from .run_parts import CONFIG, with_sections

SMALL = CEMConfig(
    planning_horizon=3, optim_steps=1, num_candidates=32, top_k=4, num_policy_candidates=2
)
TINY = CalibrateConfig(enabled=True, episodes=3, max_episodes=6)


@pytest.fixture
def restless(monkeypatch):
    """No actor is taken to rest."""
    monkeypatch.setattr(calibrate_module, "RESTS", -1.0)


def make_agent(name="brief-pendulum", planner=SMALL):
    torch.manual_seed(0)
    task = get_task(name)
    actor = Actor(task)
    return Agent(task, dynamics=HybridDynamics.hybrid(task), actor=actor, planner_config=planner)


def finished(agent, config=TINY, seed=0, path=None, others=()):
    phase = CalibratePhase(agent, config, seed=seed, path=path, others=others)
    while not phase.done:
        phase.advance()
    return phase


# The ways to plan.


def test_each_way_fits_the_settings_and_changes_them():
    ways = calmer(CEMConfig(), 0.5)
    assert list(ways) == ["calm", "mild", "loose"]
    for changes in ways.values():
        assert replace(CEMConfig(), **changes) != CEMConfig()
    alone = leaving(CEMConfig(), 1.234, 0.5)
    assert alone["leaving"] == {"actor_margin": 6.2, "margin_at_rest": True}
    assert replace(CEMConfig(), **alone["priced"]).keep_incumbent
    known = replace(CEMConfig(), warm_start=True)
    assert "warm_start" not in calmer(known, 0.5)["calm"]


def test_a_planner_is_asked_only_for_what_it_has():
    ways = calmer(MPPIConfig(), 1.0)
    assert {key for way in ways.values() for key in way} == {
        "change_cost",
        "noise_beta",
        "init_std",
    }
    assert leaving(MPPIConfig(), 1.0, 1.0) == {}


def test_what_the_settings_refuse_is_no_way():
    """The actor alone proposes plans: none goes on from the one before."""
    guided = CEMConfig(num_candidates=20, num_policy_candidates=20)
    assert calmer(guided, 1.0) == {}


def test_where_plans_promise_nothing_there_is_no_margin_to_try():
    assert leaving(CEMConfig(), 1e-4, 0.5) == {}
    narrow = calmer(replace(CEMConfig(), init_std=0.05), 0.5)
    assert all("init_std" not in changes for changes in narrow.values())


# The phase.


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
    assert list(table["ways"])[:2] == ["given", "calm"]
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


@pytest.mark.usefixtures("restless")
def test_the_budget_ends_doubt_and_leaves_ways_out():
    config = replace(TINY, episodes=5, max_episodes=10, confidence=1e6, budget=100_000)
    small = finished(make_agent(), config)
    assert list(small.final["ways"]) == ["given", "calm"]  # these two in any case, three times
    assert small.final["episodes"] == 6  # the chosen one
    assert sorted(len(returns) for returns, _ in small.contest._played.values()) == [3, 6]
    assert small.final["certain"] is False


@pytest.mark.parametrize("first", [3, 4, 5])
def test_a_chosen_way_plays_six_episodes_whatever_they_cost(first):
    config = replace(TINY, episodes=first, max_episodes=48, budget=1, confidence=1e6)
    contest = CalibratePhase(make_agent(), config, seed=0).contest
    contest.begin({"given": {}})
    contest.episodes = first
    contest.play("given")
    assert contest.go_on()
    contest.play("given")
    assert len(contest.way("given").returns) == 6
    assert not contest.go_on()


def test_dear_plans_begin_with_fewer_episodes():
    price, config = Price(SMALL), replace(TINY, episodes=6)

    def first(paid):  # for whole episodes of two plans
        paying = replace(config, budget=math.ceil(2 * 100 * price.plan(paid) / 0.45))
        return first_episodes(paying, price, 100, 2)

    assert [first(paid) for paid in (100, 6, 5, 4, 1)] == [6, 6, 5, 4, 3]


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
@pytest.mark.parametrize("taken", ["calm", "mild", "nothing"])
def test_the_first_calm_way_that_is_taken_is_the_last_that_plays(monkeypatch, taken):
    names = ["given", "calm", "mild", "loose"]

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
    assert "calm" in ways


WIDE = replace(SMALL, num_candidates=64)


def choose_the_first(ways, actor, **_):
    return Choice(next(iter(ways)), "planner", True, 1.0, 0.1)


@pytest.mark.parametrize("loses", [True, False])
def test_the_chosen_way_keeps_the_fast_budget_if_it_loses_nothing(monkeypatch, tmp_path, loses):
    monkeypatch.setattr(calibrate_module, "choose", choose_the_first)
    monkeypatch.setattr(calibrate_module, "loses_nothing", lambda cheap, plan: not loses)
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
    monkeypatch.setattr(calibrate_module, "loses_nothing", lambda cheap, plan: True)
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


def test_the_fast_budget_is_that_of_the_settings():
    fast = read_run_config(load_config("pendulum", overrides=["budget=fast"])).planner
    changes = faster(CEMConfig(50, optim_steps=9, num_candidates=900, top_k=90), {})
    assert changes == {name: getattr(fast, name) for name in changes}
    assert len(changes) == 5


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


def test_larger_networks_make_plans_dearer():
    narrow = Price.of(make_agent())
    assert narrow.critics == 0.0  # it has none
    assert narrow.actor > 1.0
    assert narrow.plan(6) > Price(SMALL).plan(6)


def test_more_steps_of_the_solver_make_plans_dearer():
    agent = make_agent()
    assert Price.of(agent).step == 1.0, "small models are alike"
    solver = make_integrator("rk4", substeps=4)
    dear = Agent(
        agent.task,
        dynamics=HybridDynamics.hybrid(agent.task, integrator=solver),
        actor=agent.actor,
        planner_config=agent.planner_config,
    )
    eager = Price.of(dear)
    assert eager.step > 3.0
    assert eager.plan(6) > 3.0 * Price.of(agent).plan(6)
    dear.dynamics.compile_step()
    assert Price.of(dear) == eager, "the compiler changes no number of episodes"


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
