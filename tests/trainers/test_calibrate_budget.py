"""What calibration costs, and what its budget leaves out."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from phihp_torchrl import Agent, HybridDynamics
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.trainers import (
    CalibratePhase,
)
from phihp_torchrl.trainers.calibrate_budget import Price, first_episodes

from .calibrate_parts import SMALL, TINY, finished, make_agent


@pytest.mark.usefixtures("restless")
def test_the_budget_ends_doubt_and_leaves_ways_out():
    config = replace(TINY, episodes=5, max_episodes=10, confidence=1e6, budget=100_000)
    small = finished(make_agent(), config)
    assert list(small.final["ways"]) == ["given", "still", "calm"]  # in any case, three times
    assert small.final["episodes"] == 6  # the chosen one
    assert sorted(len(returns) for returns, _ in small.contest._played.values()) == [3, 3, 6]
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
